"""Runs that are killed, or find the disk full, resume and end with the same files."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import FormatError
from recon.map.map import Map
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.kitti import write_kitti

STREET = StreetScene(frames=16, width_px=256, height_px=96, focal_px=150.0, smooth_edges=False)
"""Large enough that every pose is trusted."""
SETTINGS = ["checkpoints.every_frames=5", "submaps.length_m=4", "submaps.tile_m=12.8"]
ROOT = Path(__file__).parents[2]
BREAKER = Path(__file__).with_name("break_at_write.py")
KILLED_RUNS = 4

# A dozen runs in a test: what the machine does beside them may take most of it.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


class Runs:
    """One drive, and the result of an uninterrupted run."""

    def __init__(self, folder: Path) -> None:
        self.drive = folder / "drive"
        write_kitti(SyntheticSource(STREET), self.drive)
        self.counted = folder / "count"
        done = self.broken(folder / "unbroken", "count", 0)
        assert done.returncode == 0, done.stderr
        self.writes = int(self.counted.read_text())
        self.content = content(folder / "unbroken")
        # The last writes move finished files to their places.
        self.before_moving = self.writes - len(list((folder / "unbroken").rglob("*.*")))

    def arguments(self, out: Path) -> list[str]:
        """Start the run, or resume it if it has begun."""
        if begun(out):
            return ["map", "--quiet", "--resume", str(out)]
        settings = [part for text in SETTINGS for part in ("--set", text)]
        return ["map", "--quiet", str(self.drive), "--out", str(out), "--no-mesh", *settings]

    def broken(self, out: Path, mode: str, at: int) -> subprocess.CompletedProcess[str]:
        return self.breaking(mode, at, *self.arguments(out))

    def breaking(self, mode: str, at: int, *words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(BREAKER), mode, str(at), *words]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "COUNT": str(self.counted)}
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)

    def finish(self, out: Path) -> None:
        """Resume to the end and compare with the files of the uninterrupted run."""
        if not (out / "run.json").exists():
            command = [sys.executable, "-m", "recon", *self.arguments(out)]
            subprocess.run(command, check=True, capture_output=True)
        assert content(out) == self.content
        assert not list(out.rglob(".*-*")), "a temporary file was left"


def begun(out: Path) -> bool:
    """Whether a run has committed what it was started with."""
    try:
        with Map.open(out / ".partial" / ".state" / "map.recon") as unfinished:
            return len(unfinished.sessions) > 0
    except FormatError:
        return False


def content(folder: Path) -> dict[str, bytes]:
    """All files of a run except those with timings."""
    timed = {"summary.json", "run.json", "report.html"}
    files = [path for path in folder.rglob("*") if path.is_file() and ".partial" not in path.parts]
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in files
        if path.name not in timed
    }


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    return Runs(tmp_path_factory.mktemp("runs"))


def test_runs_killed_again_and_again_give_the_same_files(runs: Runs, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for number in range(KILLED_RUNS):
        out = tmp_path / f"run{number}"
        for at in rng.integers(2, runs.writes // 2, 3):
            # What is resumed has fewer writes to do, and may end before it gets there.
            runs.broken(out, "kill", int(at))
        runs.finish(out)


@pytest.mark.parametrize("what", ["mapping", "exporting", "moving", "done"])
def test_runs_killed_at_a_write_give_the_same_files(runs: Runs, tmp_path: Path, what: str) -> None:
    last = {
        "mapping": runs.writes // 4,
        "exporting": runs.before_moving - 4,
        "moving": runs.before_moving + 3,
        "done": runs.writes,
    }[what]
    for at in (last - 1, last):  # one before the write, one after it
        out = tmp_path / str(at)
        done = runs.broken(out, "kill", at)
        assert done.returncode == -signal.SIGKILL
        runs.finish(out)


@pytest.mark.parametrize("what", ["beginning", "mapping", "exporting"])
def test_a_full_disk_is_one_line_and_the_run_goes_on_when_there_is_room(
    runs: Runs, tmp_path: Path, what: str
) -> None:
    at = {"beginning": 8, "mapping": runs.writes // 3, "exporting": runs.before_moving - 4}[what]
    done = runs.broken(tmp_path / "run", "full", at)
    assert done.returncode == 1
    [line] = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert "No space left on device" in line
    assert f"recon map --resume {tmp_path / 'run'} goes on from there" in line
    assert [path.name for path in (tmp_path / "run").iterdir()] == [".partial"]
    runs.finish(tmp_path / "run")


def test_a_disk_that_is_full_at_once_is_one_line_and_leaves_nothing(
    runs: Runs, tmp_path: Path
) -> None:
    done = runs.broken(tmp_path / "run", "full", 2)
    assert done.returncode == 1
    [line] = done.stderr.splitlines()
    assert "No space left on device" in line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("command", ["mesh", "occupancy"])
def test_what_is_made_of_a_run_stays_as_it_was_when_it_cannot_be_made_again(
    runs: Runs, tmp_path: Path, command: str
) -> None:
    out, run = tmp_path / "out", runs.drive.parent / "unbroken"

    def again(mode: str, at: int) -> subprocess.CompletedProcess[str]:
        changes = ["--set", "mesh.tile_m=10"] if command == "mesh" else []
        return runs.breaking(mode, at, command, str(run), "--out", str(out), "--quiet", *changes)

    assert again("count", 0).returncode == 0
    writes = int(runs.counted.read_text())
    made = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    for mode, code, words in (("full", 1, "error: .*No space left"), ("interrupt", 130, "interr")):
        # In the first third the run is read, in the others its products are made.
        for at in (writes // 6, writes // 2):
            done = again(mode, at)
            assert done.returncode == code
            [line] = done.stderr.splitlines()
            assert re.match(words, line)
            assert made == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
