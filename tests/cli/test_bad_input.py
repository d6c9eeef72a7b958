"""Bad input gets one clear line, exit code 1, and leaves nothing behind."""

import io
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer

from recon.cli.errors import one_line_errors
from recon.core.kernels.cache import announce, note_compiling
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.hostile.refusals import Ended, assert_refused, run
from tests.scenery.kitti import write_kitti


@pytest.fixture(scope="module")
def good_drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    size = {"width_px": 128, "height_px": 64, "focal_px": 72.0}
    write_kitti(SyntheticSource(StreetScene(frames=3, smooth_edges=False, **size)), folder)
    return folder


@pytest.fixture
def drive(good_drive, tmp_path):
    return Path(shutil.copytree(good_drive, tmp_path / "drive"))


def assert_one_line(done: Ended, *words: str) -> None:
    """Assert a refusal without as much as a warning beside it."""
    assert_refused(done, *words)
    assert len([line for line in done.err.splitlines() if not line.startswith("{")]) == 1, done.err


def shrink_right_images(drive: Path) -> None:
    for path in drive.glob("image_[13]/*.png"):
        cv2.imwrite(str(path), np.zeros((32, 64, 3), np.uint8))


def cut_off_an_image(drive: Path) -> None:
    for path in drive.glob("image_[02]/000001.png"):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def lose_the_baseline(drive: Path) -> None:
    calib = drive / "calib.txt"
    rows = [line.split() for line in calib.read_text().splitlines()]
    rows = [[*row[:4], "0", *row[5:]] if row[0].startswith("P") else row for row in rows]
    calib.write_text("".join(" ".join(row) + "\n" for row in rows))


def break_a_pose(drive: Path) -> None:
    first, second, *others = (drive / "poses.txt").read_text().splitlines()
    second = " ".join(["nan", *second.split()[1:]])
    (drive / "poses.txt").write_text("\n".join([first, second, *others]) + "\n")


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "sizes that differ": (shrink_right_images, "64x32"),
    "truncated PNG": (cut_off_an_image, "000001.png"),
    "zero baseline": (lose_the_baseline, "baseline"),
    "NaN poses": (break_a_pose, "poses.txt"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_drive_is_refused(drive, tmp_path, fault):
    spoil, word = FAULTS[fault]
    spoil(drive)
    assert_one_line(run("map", drive, "--out", tmp_path / "out", "--json"), word)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("option", "content", "word"),
    [
        ("--poses", "nan 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "given.txt"),
        ("--poses", "1 0 0 0 0 1 0 0 0 0 1 0\n", "pose"),
        ("--prior", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "8"),  # without times
        ("--prior", "".join(f"{1.7e9 + k} 0 0 {k} 0 0 0 1\n" for k in range(3)), "same clock"),
        ("--prior", "0 0 0 0 0 0 0 1\n", "two poses"),
        ("--prior", "0 0 0 0 0 0 0 one\n", "given.txt"),
        ("--set=matching.no_such_setting=1", "", "no_such_setting"),
        ("--set=matching.window_px=-3", "", "window_px"),
        ("--set=nonsense", "", "key=value"),
        ("--length=0,2", "", "source.length"),
        ("--length=0,9999,3", "", "no such frames"),
    ],
)
def test_wrong_poses_priors_and_settings_are_refused(good_drive, tmp_path, option, content, word):
    (tmp_path / "given.txt").write_text(content)
    words = [option] if "=" in option else [option, tmp_path / "given.txt"]
    assert_one_line(run("map", good_drive, *words, "--out", tmp_path / "out", "--quiet"), word)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "word"),
    [
        (["--into", "run", "--keep", "0"], "--keep: not what a map may keep"),
        (["--into", "run", "--keep=5,0,1,9"], "got 5,0,1,9"),
        (["--into", "run", "--keep", "2", "--keep", "3"], "each once"),
        (["--date", "yesterday"], "--date: not the date of a drive"),
        (["--date", "1950-01-01"], "from 1990"),
    ],
)
def test_what_a_map_cannot_keep_and_what_is_no_date_are_refused(good_drive, tmp_path, words, word):
    assert_one_line(run("map", good_drive, *words, "--quiet"), word)
    assert not (tmp_path / "outputs").exists()


@pytest.mark.parametrize(
    "line",
    [
        "map", "map x --no-such-option", "map x --poses p --prior q", "map --remove 1",
        "map x --into run --remove 1", "map x --into run --out o", "map --into run --resume run",
        "map x --keep 2", "map --into run", "map --resume run --date 2024-11-30",
        "map x --into run --workers 2", "map --resume a --out b", "map x --workers 2 --scheduler s",
        "evaluate middlebury x --json --latex", "board",
        "board chess:9x6 --board chess:9x6", "batch", "batch map x --resume y", "piece plan 0",
    ],
)  # fmt: skip
def test_wrong_usage_exits_with_two(line):
    assert run(*line.split()).code == 2


def test_an_import_that_ctrl_c_stops_is_an_interruption_and_any_other_an_error(capsys):
    with pytest.raises(typer.Exit) as ended, one_line_errors():
        raise ImportError("initialization failed") from KeyboardInterrupt()
    assert (ended.value.exit_code, capsys.readouterr().err) == (130, "interrupted\n")
    with pytest.raises(typer.Exit) as ended, one_line_errors():
        raise ImportError("nothing of that name")
    assert ended.value.exit_code == 1


@pytest.mark.parametrize("code", [0, None, 7])
def test_a_package_that_ends_the_program_is_an_error_whatever_its_code(code, capsys):
    with pytest.raises(typer.Exit) as ended, one_line_errors():
        raise SystemExit(code)
    assert ended.value.exit_code == 1
    assert capsys.readouterr().err == (
        f"error: a package that recon uses ended the program (sys.exit({code}))\n"
    )


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown(monkeypatch: pytest.MonkeyPatch, stream: io.StringIO, *, quiet: bool) -> list[str]:
    """What is said of kernels while a command meets two that are not compiled."""
    monkeypatch.setattr("sys.stderr", stream)
    note_compiling.cache_clear()
    with one_line_errors(quiet=quiet):
        announce("first")
        announce("second")
    return [line for line in stream.getvalue().splitlines() if "compiling" in line]


def test_a_terminal_alone_is_told_once_that_kernels_are_compiled(monkeypatch):
    (line,) = shown(monkeypatch, Terminal(), quiet=False)
    assert "compiling kernels, once" in line
    assert shown(monkeypatch, Terminal(), quiet=True) == []
    assert shown(monkeypatch, io.StringIO(), quiet=False) == []
