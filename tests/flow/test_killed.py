"""Whatever ends a command leaves whole files, or none; what goes on ends with the same files."""

import json
import re
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

from recon.map.map import Map
from tests.flow.runs import STATE, all_files, begun, broken, content, count_writes
from tests.scenery.kitti import street_drive

FRAMES, MAPPED = 40, 16
SETTINGS = ("checkpoints.every_frames=5", "submaps.length_m=4", "submaps.tile_m=12.8")
INTERRUPTED = 130

# A dozen runs in a test: what the machine does beside them may take most of it.
pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return street_drive(tmp_path_factory.mktemp("drive"), FRAMES)


class Runs:
    """The run of a drive, and the result where nothing interrupts it."""

    def __init__(self, drive: Path, folder: Path) -> None:
        self.drive, self.whole = drive, folder / "whole"
        self.writes = count_writes(self.whole, *self.words(self.whole))
        # The last writes move finished files to their places.
        self.before_moving = self.writes - len(list(self.whole.rglob("*.*")))

    def words(self, out: Path) -> list[object]:
        """Start the run, or resume it if it has begun."""
        if begun(out):
            return ["map", "--resume", out]
        settings = [f"--set={text}" for text in SETTINGS]
        return ["map", self.drive, "--end", MAPPED, "--out", out, "--no-mesh", *settings]

    def broken(self, mode: str, at: int, out: Path) -> tuple[int, list[str]]:
        done = broken(mode, at, out, *self.words(out))
        return done.returncode, done.stderr.splitlines()

    def finish(self, out: Path) -> None:
        if not (out / "run.json").exists():
            count_writes(out, *self.words(out))
        assert content(out) == content(self.whole)
        assert not list(out.rglob(".*-*")), "a temporary file was left"


@pytest.fixture(scope="module")
def runs(drive, tmp_path_factory):
    return Runs(drive, tmp_path_factory.mktemp("runs"))


def test_runs_killed_again_and_again_give_the_same_files(runs, tmp_path):
    rng = np.random.default_rng(0)
    for number in range(4):
        out = tmp_path / f"run{number}"
        for at in rng.integers(2, runs.writes // 2, 3):
            # What is resumed has fewer writes to do, and may end before it gets there.
            runs.broken("kill", int(at), out)
        runs.finish(out)


@pytest.mark.parametrize("what", ["mapping", "exporting", "moving", "done"])
def test_runs_killed_at_a_write_give_the_same_files(runs, tmp_path, what):
    last = {
        "mapping": runs.writes // 4,
        "exporting": runs.before_moving - 4,
        "moving": runs.before_moving + 3,
        "done": runs.writes,
    }[what]
    for at in (last - 1, last):  # one before the write, one after it
        out = tmp_path / str(at)
        assert runs.broken("kill", at, out)[0] == -signal.SIGKILL
        runs.finish(out)


@pytest.mark.parametrize("what", ["beginning", "mapping", "exporting"])
def test_a_run_on_a_full_disk_goes_on_with_room(runs, tmp_path, what):
    at = {"beginning": 8, "mapping": runs.writes // 3, "exporting": runs.before_moving - 4}[what]
    out = tmp_path / "run"
    code, [line] = runs.broken("full", at, out)
    assert code == 1
    assert re.match(r"error: .*No space left on device", line)
    assert f"recon map --resume {out} goes on from there" in line
    assert [path.name for path in out.iterdir()] == [".partial"]
    runs.finish(out)


@pytest.mark.parametrize("command", ["mesh", "occupancy"])
def test_products_stay_when_they_cannot_be_made(runs, tmp_path, command):
    out, changes = tmp_path / "out", ["--set=mesh.tile_m=10"] if command == "mesh" else []
    words = (command, runs.whole, "--out", out, *changes)
    writes, made = count_writes(out, *words), all_files(out)
    for mode, code, said in (("full", 1, "error: .*No space left"), ("interrupt", 130, "interr")):
        # In the first third the run is read, in the others its products are made.
        for at in (writes // 6, writes // 2):
            done = broken(mode, at, out, *words)
            assert done.returncode == code
            [line] = done.stderr.splitlines()
            assert re.match(said, line)
            assert all_files(out) == made


def _frames(file: Path) -> int:
    """Read all that a map holds; its number of frames, 0 if there is none."""
    if not file.exists():
        return 0
    with Map.open(file) as map_:
        for session in map_.sessions:
            if not len(session):
                continue
            assert np.isfinite(session.odometry.T_world_camera).all()
            assert session.submaps.frames == session.ray_frames == len(session)
            for entry in session.submaps.entries:
                assert session.submaps[entry.index].frames == entry.frames
            assert all(stored.keyframe.frame < len(session) for stored in session.keyframes)
        frames = sum(map(len, map_.sessions))
        if frames:
            assert sum(len(tile.voxels) for tile in map_.tiles()) > 0
        return frames


def test_a_live_drive_that_is_killed_leaves_a_map_that_opens(tmp_path):
    drive = street_drive(tmp_path / "drive", FRAMES, 512)  # poses are from images of half the size
    words, whole = ("live", drive, "--rate", 1000, "--no-mesh", "--out"), tmp_path / "whole"
    writes = count_writes(whole, *words, whole)
    assert _frames(whole / "map" / "map.recon") == FRAMES
    # The last writes move finished files to their places; before, products are made.
    exporting, half, kept = writes - len(all_files(whole)) - 4, FRAMES // 2, []
    for at in (2, 3, half, half + 1, exporting):
        out = tmp_path / str(at)
        assert broken("kill", at, out, *words, out).returncode == -signal.SIGKILL
        assert not (out / "run.json").exists()
        kept.append(_frames(out / STATE))
    assert kept == sorted(kept)
    assert kept[0] < FRAMES // 3 < kept[2] < kept[-1] == FRAMES


def test_a_merge_that_is_killed_leaves_a_whole_folder_or_none(drive, tmp_path):
    runs, whole = [tmp_path / "first", tmp_path / "second"], tmp_path / "whole"
    for run, first in zip(runs, (0, 6), strict=True):
        part = ("--start", first, "--end", first + 14)
        count_writes(run, "map", drive, "--no-mesh", *part, "--out", run)
    merge = ("merge", *runs, "--no-mesh", "--out")
    writes = count_writes(whole, *merge, whole)
    for at in sorted({2, 5, writes // 2, writes - 6, writes - 3, writes - 1, writes}):
        out = tmp_path / str(at)
        assert broken("kill", at, out, *merge, out).returncode == -signal.SIGKILL
        if not (out / "run.json").exists():
            count_writes(out, *merge, out)  # what is left of the other is in nobody's way
        assert content(out) == content(whole)
        record = json.loads((out / "run.json").read_text())
        assert all((out / name).is_file() for name in record["files"])
        assert _frames(out / "map" / "map.recon") == 28


def test_a_run_whose_change_is_interrupted_stays_as_it_was(drive, tmp_path):
    run, changed = tmp_path / "before" / "run", tmp_path / "changed" / "run"
    count_writes(tmp_path / "run", "map", drive, "--no-mesh", "--end", 14, "--out", run)
    for words in (("map", drive, "--start", 6, "--end", 20), ("map", "--remove", 1)):
        shutil.copytree(run, changed)
        into = (*words, "--no-mesh", "--into")
        writes, before = count_writes(tmp_path / "run", *into, changed), all_files(run.parent)
        for mode, at in (("terminate", 2), ("interrupt", writes // 2), ("terminate", writes)):
            assert broken(mode, at, tmp_path / "run", *into, run).returncode == INTERRUPTED
            assert all_files(run.parent) == before
        shutil.rmtree(run)
        changed.rename(run)
