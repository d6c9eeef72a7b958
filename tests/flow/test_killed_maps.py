"""Whatever ends a live drive or a merge, the map on disk is whole, or there is none."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from recon.map.map import Map
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.flow.test_killed_runs import BREAKER, content
from tests.scenery.kitti import write_kitti

STREET = StreetScene(frames=40, width_px=256, height_px=96, focal_px=150.0, smooth_edges=False)
ROOT = Path(__file__).parents[2]
INTERRUPTED = 130

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    write_kitti(SyntheticSource(STREET), folder)
    return folder


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


def _broken(mode: str, at: int, out: Path, *words: object) -> int:
    """Run a command that ends at its n-th write, or count its writes; the exit code."""
    target = () if "--into" in words else ("--out", out)
    command = [sys.executable, str(BREAKER), mode, at, *words, *target, "--quiet"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COUNT": f"{out}.count"}
    return subprocess.run([*map(str, command)], env=environment, check=False).returncode


def _files(folder: Path) -> dict[Path, bytes]:
    """All files below a folder, hidden ones too."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_live_drive_that_is_killed_leaves_a_map_that_opens(drive: Path, tmp_path: Path) -> None:
    words = ("live", drive, "--rate", 1000, "--no-mesh")
    assert _broken("count", 0, tmp_path / "whole", *words) == 0
    assert _frames(tmp_path / "whole" / "map" / "map.recon") == STREET.frames
    files = len([path for path in (tmp_path / "whole").rglob("*") if path.is_file()])
    # The last writes move finished files to their places; before, products are made.
    exporting = int((tmp_path / "whole.count").read_text()) - files - 4
    half, kept = STREET.frames // 2, []
    for at in (2, 3, half, half + 1, exporting):
        out = tmp_path / str(at)
        assert _broken("kill", at, out, *words) == -signal.SIGKILL
        assert not (out / "run.json").exists()
        kept.append(_frames(out / ".partial" / ".state" / "map.recon"))
    assert kept == sorted(kept)
    assert kept[0] < STREET.frames // 3 < kept[2] < kept[-1] == STREET.frames


def test_a_merge_that_is_killed_leaves_a_whole_folder_or_none(drive: Path, tmp_path: Path) -> None:
    runs = [tmp_path / "first", tmp_path / "second"]
    for run, first in zip(runs, (0, 6), strict=True):
        words = ("map", drive, "--no-mesh", "--start", first, "--end", first + 14)
        assert _broken("count", 0, run, *words) == 0
    merge = ("merge", *runs, "--no-mesh")
    assert _broken("count", 0, tmp_path / "whole", *merge) == 0
    writes, whole = int((tmp_path / "whole.count").read_text()), content(tmp_path / "whole")
    for at in sorted({2, 5, writes // 2, writes - 6, writes - 3, writes - 1, writes}):
        out = tmp_path / str(at)
        assert _broken("kill", at, out, *merge) == -signal.SIGKILL
        if not (out / "run.json").exists():
            assert (
                _broken("count", 0, out, *merge) == 0
            )  # what is left of the other is in nobody's way
        assert content(out) == whole
        record = json.loads((out / "run.json").read_text())
        assert all((out / name).is_file() for name in record["files"])
        assert _frames(out / "map" / "map.recon") == 28


def test_a_run_whose_change_is_ended_by_a_signal_stays_as_it_was(
    drive: Path, tmp_path: Path
) -> None:
    run, changed = tmp_path / "before" / "run", tmp_path / "changed" / "run"
    assert _broken("count", 0, run, "map", drive, "--no-mesh", "--end", 14) == 0
    drive_after = ("map", drive, "--start", 6, "--end", 20)
    for words in (drive_after, ("map", "--remove", 1)):
        shutil.copytree(run, changed)
        into = (*words, "--no-mesh", "--into")
        assert _broken("count", 0, changed, *into, changed) == 0
        writes, before = int(Path(f"{changed}.count").read_text()), _files(run.parent)
        for mode, at in (("terminate", 2), ("interrupt", writes // 2), ("terminate", writes)):
            assert _broken(mode, at, run, *into, run) == INTERRUPTED
            assert _files(run.parent) == before
        shutil.rmtree(run)
        changed.rename(run)
