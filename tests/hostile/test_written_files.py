"""Files that commands are told to write: regular ones, and never what they read."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from tests.hostile.refusals import assert_refused, run

pytestmark = pytest.mark.usefixtures("blank_figures")


def a_device() -> None:
    Path("target").symlink_to(os.devnull)


def a_pipe() -> None:
    os.mkfifo("target")


def a_folder() -> None:
    Path("target").mkdir()


def the_calibration_by_a_hard_link() -> None:
    Path("target").hardlink_to("drive/calib.txt")


def the_calibration_by_a_link() -> None:
    Path("target").symlink_to("drive/calib.txt")


def an_image_by_a_link_to_a_link() -> None:
    Path("between").symlink_to("drive/image_0/000001.png")
    Path("target").symlink_to("between")


def the_configuration() -> None:
    Path("target").symlink_to("config.yaml")


TARGETS: Final[dict[str, Callable[[], None]]] = {
    make.__name__: make
    for make in (
        a_device,
        a_pipe,
        a_folder,
        the_calibration_by_a_hard_link,
        the_calibration_by_a_link,
        an_image_by_a_link_to_a_link,
        the_configuration,
    )
}


def state(folder: Path) -> dict[str, tuple[int, int, bytes]]:
    """Kind, number and content of all that is in a folder, links not followed."""
    return {
        str(path): (
            path.lstat().st_mode,
            path.lstat().st_ino,
            path.read_bytes() if path.is_file() else b"",
        )
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize("target", TARGETS)
def test_a_mended_calibration_replaces_no_input_and_no_device(drive: Path, target: str) -> None:
    Path("config.yaml").write_text("matching: {matcher: sad}\n")
    TARGETS[target]()
    before = state(drive.parent)
    command = ("audit", "drive", "--config", "config.yaml", "--mend", "target", "--quiet")
    assert_refused(run(*command), "target: ")
    assert state(drive.parent) == before


@pytest.mark.parametrize("name", ["drive/calib.txt", "", ".", "drive/times.txt"])
def test_a_mended_calibration_is_a_file_of_its_own(drive: Path, name: str) -> None:
    before = state(drive)
    assert_refused(run("audit", "drive", "--mend", name, "--quiet"), name)
    assert state(drive) == before


def test_a_calibration_replaces_no_picture_of_the_board(pair: tuple[Path, Path]) -> None:
    Path("rig_left.yaml").hardlink_to("left.png")
    before = state(pair[0].parent)
    board = ("--board", "chess:9x6:25mm", "--report", "report")
    for words in (("left.png",), ("right.png",), ("rig.yaml", "--format", "ros")):
        command = ("calibrate", "left.png", "right.png", *board, "-o", *words)
        assert_refused(run(*command), "would replace an input")
    assert state(pair[0].parent) == before


def test_a_board_is_not_printed_into_a_device(here: Path) -> None:
    Path("board.pdf").symlink_to(os.devnull)
    assert_refused(run("board", "chess:9x6:25mm"), "board.pdf: ", "a device")
    assert Path("board.pdf").is_symlink()


@pytest.mark.parametrize("name", ["map/grid.pgm", "run.json"])
def test_a_drawing_replaces_no_file_of_the_run(finished: Path, name: str) -> None:
    before = state(finished)
    command = ("evaluate", "occupancy", "run", "--picture", f"run/{name}")
    assert_refused(run(*command), f"run/{name}", "would replace an input")
    assert state(finished) == before


MADE_OF: Final = {
    "a map compared with itself": ("evaluate", "map", "run", "run/map/cloud.ply"),
    "its cloud": ("evaluate", "map", "run/map/cloud.ply", "run/map/cloud.ply"),
    "its path": ("evaluate", "trajectory", "run/trajectory_tum.txt", "run/trajectory_tum.txt"),
    "a drive at its poses": ("map", "drive", "--poses", "run/trajectory_tum.txt"),
}


@pytest.mark.parametrize("command", MADE_OF)
@pytest.mark.parametrize("out", ["run", "linked"])
def test_results_do_not_replace_the_files_that_they_are_made_of(
    command: str, out: str, finished: Path, good_state: Path
) -> None:
    Path("drive").symlink_to(good_state / "drive")
    shutil.copytree(finished, "linked")
    for name in ("map/cloud.ply", "trajectory_tum.txt"):
        Path("linked", name).unlink()
        Path("linked", name).hardlink_to(finished / name)
    before = state(Path(out))
    assert_refused(run(*MADE_OF[command], "--out", out), "would replace an input")
    assert state(Path(out)) == before


def test_results_do_not_replace_what_is_no_regular_file(finished: Path) -> None:
    shutil.copytree(finished, "other")
    Path("other/map/cloud.ply").unlink()
    os.mkfifo("other/map/cloud.ply")
    before = state(Path("other"))
    assert_refused(run("export", "run", "--to", "cloud", "--out", "other"), "a named pipe")
    assert state(Path("other")) == before
