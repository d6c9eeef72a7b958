"""Bad input gets one clear line, exit code 1, and leaves nothing behind."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer

from recon.cli.errors import one_line_errors
from recon.core.kernels.cache import announce
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.hostile.refusals import Ended, assert_refused, run, run_apart
from tests.scenery.kitti import write_kitti


@pytest.fixture(scope="module")
def good_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    size = {"width_px": 128, "height_px": 64, "focal_px": 72.0}
    write_kitti(SyntheticSource(StreetScene(frames=3, smooth_edges=False, **size)), folder)
    return folder


@pytest.fixture
def drive(good_drive: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good_drive, tmp_path / "drive"))


def assert_one_line(done: Ended, *words: str) -> None:
    """Assert a refusal without as much as a warning beside it."""
    assert_refused(done, *words)
    assert len([line for line in done.err.splitlines() if not line.startswith("{")]) == 1, done.err


def right_pictures(drive: Path) -> list[Path]:
    return sorted(next(p for p in (drive / "image_3", drive / "image_1") if p.is_dir()).iterdir())


def lose_most_right_images(drive: Path) -> str:
    for victim in right_pictures(drive)[1:]:
        for side in ("image_1", "image_3"):
            (drive / side / victim.name).unlink(missing_ok=True)
    return "most images have no partner"


def shrink_right_pictures(drive: Path) -> str:
    for side in ("image_1", "image_3"):
        for path in (drive / side).glob("*.png"):
            cv2.imwrite(str(path), np.zeros((32, 64, 3), np.uint8))
    return "64x32"


def truncate_a_picture(drive: Path) -> str:
    for side in ("image_0", "image_2"):
        for path in sorted((drive / side).glob("*.png"))[1:2]:
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return "000001.png"


def forget_the_right_cameras(drive: Path) -> str:
    calib = drive / "calib.txt"
    lines = [line for line in calib.read_text().splitlines() if line[:2] in {"P0", "P2"}]
    calib.write_text("\n".join(lines) + "\n")
    return "calib.txt"


def lose_the_baseline(drive: Path) -> str:
    calib = drive / "calib.txt"
    lines = []
    for line in calib.read_text().splitlines():
        name, *numbers = line.split()
        if name.startswith("P"):
            numbers[3] = "0"
        lines.append(" ".join([name, *numbers]))
    calib.write_text("\n".join(lines) + "\n")
    return "baseline"


def empty_the_folder(drive: Path) -> str:
    shutil.rmtree(drive)
    drive.mkdir()
    return "empty"


def break_a_pose(drive: Path) -> str:
    poses = drive / "poses.txt"
    lines = poses.read_text().splitlines()
    lines[1] = " ".join(["nan", *lines[1].split()[1:]])
    poses.write_text("\n".join(lines) + "\n")
    return "poses.txt"


FAULTS: dict[str, Callable[[Path], str]] = {
    "most right images missing": lose_most_right_images,
    "sizes that differ": shrink_right_pictures,
    "truncated PNG": truncate_a_picture,
    "calib.txt without P1 and P3": forget_the_right_cameras,
    "zero baseline": lose_the_baseline,
    "empty folder": empty_the_folder,
    "NaN poses": break_a_pose,
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_drive_is_refused(drive: Path, tmp_path: Path, fault: str) -> None:
    word = FAULTS[fault](drive)
    done = run("map", drive, "--out", tmp_path / "out", "--json")
    assert_one_line(done, word)
    assert not (tmp_path / "out").exists()


def test_a_process_that_refuses_a_drive_ends_with_one(drive: Path, tmp_path: Path) -> None:
    """The other tests run commands inside of this process."""
    word = lose_the_baseline(drive)
    assert_one_line(run_apart("map", drive, "--out", tmp_path / "out", "--json"), word)


def test_an_unwritable_output_folder_is_refused(drive: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    done = run("map", drive, "--out", tmp_path / "file" / "out", "--json")
    assert_one_line(done, str(tmp_path / "file"))
    assert (tmp_path / "file").read_text() == "no folder"


@pytest.mark.parametrize(
    ("option", "content", "word"),
    [
        ("--poses", "nan 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "given.txt"),
        ("--poses", "1 0 0 0 0 1 0 0 0 0 1 0\n", "pose"),
        ("--prior", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "8"),  # without times
        ("--prior", "".join(f"{1.7e9 + k} 0 0 {k} 0 0 0 1\n" for k in range(3)), "same clock"),
        ("--prior", "0 0 0 0 0 0 0 1\n", "two poses"),
        ("--prior", "0 0 0 0 0 0 0 one\n", "given.txt"),
        ("--set=matching.sad.no_such_setting=1", "", "no_such_setting"),
        ("--set=matching.sad.window_px=-3", "", "window_px"),
        ("--set=nonsense", "", "key=value"),
    ],
)
def test_wrong_poses_priors_and_settings_are_refused(
    good_drive: Path, tmp_path: Path, option: str, content: str, word: str
) -> None:
    (tmp_path / "given.txt").write_text(content)
    words = [option] if "=" in option else [option, tmp_path / "given.txt"]
    assert_one_line(run("map", good_drive, *words, "--out", tmp_path / "out", "--quiet"), word)
    assert not (tmp_path / "out").exists()


def test_a_pair_of_two_sizes_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "left.png"), np.zeros((40, 60), np.uint8))
    cv2.imwrite(str(tmp_path / "right.png"), np.zeros((40, 50), np.uint8))
    done = run("disparity", tmp_path / "left.png", tmp_path / "right.png")
    assert_one_line(done, "60x40", "50x40")


def test_a_cloud_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "cloud.ply").write_text("ply\nformat ascii 1.0\nelement vertex 3\n")
    done = run("mesh", tmp_path / "cloud.ply", "--out", tmp_path / "out")
    assert_one_line(done, "cloud.ply")
    assert not (tmp_path / "out").exists()


def test_evaluating_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    (tmp_path / "ref.ply").write_text("ply\n")
    done = run("evaluate", "map", tmp_path, tmp_path / "ref.ply", "--json")
    assert_one_line(done, str(tmp_path))


@pytest.mark.parametrize(
    "line",
    [
        "map", "map x --no-such-option", "map x --poses p --prior q", "map --remove 1",
        "map x --into run --remove 1", "map x --into run --out o", "map --into run --resume run",
        "map x --into run --workers 2", "map --resume a --out b", "map x --workers 2 --scheduler s",
        "evaluate middlebury x --json --latex", "board",
        "board chess:9x6 --board chess:9x6", "batch", "batch map x --resume y", "piece plan 0",
    ],
)  # fmt: skip
def test_wrong_usage_exits_with_two(line: str) -> None:
    assert run(*line.split()).code == 2


@pytest.mark.parametrize("option", ["--json", "--latex"])
def test_tables_are_json_or_latex(tmp_path: Path, option: str) -> None:
    assert_one_line(run("evaluate", "middlebury", tmp_path, option), str(tmp_path))


def test_ctrl_c_while_a_native_library_starts_is_an_interruption(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(typer.Exit) as ended, one_line_errors():
        raise ImportError("initialization failed") from KeyboardInterrupt()
    assert ended.value.exit_code == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_a_library_that_is_missing_is_no_interruption() -> None:
    with pytest.raises(typer.Exit) as ended, one_line_errors():
        raise ImportError("nothing of that name")
    assert ended.value.exit_code == 1


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown(
    monkeypatch: pytest.MonkeyPatch, stream: io.StringIO, *, quiet: bool = False
) -> list[str]:
    """What standard error gets while a command meets two kernels that are not compiled."""
    monkeypatch.setattr("sys.stderr", stream)
    with one_line_errors(quiet=quiet):
        announce("first")
        announce("second")
    return stream.getvalue().splitlines()


def test_it_is_one_line_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = shown(monkeypatch, Terminal())
    assert line.startswith("compiling kernels, once")


def test_it_is_no_line_in_a_pipe_or_where_progress_is_not_wanted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert shown(monkeypatch, io.StringIO()) == []
    assert shown(monkeypatch, Terminal(), quiet=True) == []
