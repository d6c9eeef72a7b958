"""Whatever ends a live drive or a merge, the map on disk is whole, or there is none."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from recon.map.store.map import Map
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.flow.test_killed_runs import BREAKER, content, kill
from tests.scenery.kitti import write_kitti

STREET = StreetScene(frames=40, width_px=256, height_px=96, focal_px=150.0, smooth_edges=False)
KILLS = 6
PLAYED_S = 16.0
"""Long enough for some commits."""

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    write_kitti(SyntheticSource(STREET), folder)
    return folder


def _recon(*words: object) -> list[str]:
    return [sys.executable, "-m", "recon", *map(str, words), "--quiet"]


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
                assert session.submaps.get(entry.index).frames == entry.frames
            assert all(stored.keyframe.frame < len(session) for stored in session.keyframes)
        frames = sum(map(len, map_.sessions))
        if frames:
            assert sum(len(tile.voxels) for tile in map_.tiles()) > 0
        return frames


def test_a_live_drive_that_is_killed_leaves_a_map_that_opens(drive: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rate = 0.1 * STREET.frames / PLAYED_S
    begun = time.monotonic()
    subprocess.run(
        _recon("live", drive, "--rate", rate, "--out", tmp_path / "whole"), check=True, text=True
    )
    whole_s = time.monotonic() - begun
    found = []
    for number in range(KILLS):
        out = tmp_path / str(number)
        command = _recon("live", drive, "--rate", rate, "--out", out)
        # The last of them while the products are made, or not at all.
        if kill(command, rng.uniform(0.2, 1.0) * whole_s) and not (out / "run.json").exists():
            found.append(_frames(out / ".partial" / ".state" / "map.recon"))

    assert len(found) >= 2
    assert max(found) > 0
    assert _frames(tmp_path / "whole" / "map" / "map.recon") > 0


def test_a_merge_that_is_killed_leaves_a_whole_folder_or_none(drive: Path, tmp_path: Path) -> None:
    runs = [tmp_path / "first", tmp_path / "second"]
    for run, first in zip(runs, (0, 6), strict=True):
        words = ("map", drive, "--no-mesh", "--start", first, "--end", first + 14, "--out", run)
        subprocess.run(_recon(*words), check=True)
    os.environ["COUNT"] = str(tmp_path / "count")

    def merged(mode: str, at: int, out: Path) -> int:
        words = ["merge", *map(str, runs), "--no-mesh", "--quiet", "--out", str(out)]
        command = [sys.executable, str(BREAKER), mode, str(at), *words]
        return subprocess.run(command, check=False).returncode

    assert merged("count", 0, tmp_path / "whole") == 0
    writes, whole = int((tmp_path / "count").read_text()), content(tmp_path / "whole")
    for at in sorted({2, 5, writes // 2, writes - 6, writes - 3, writes - 1, writes}):
        out = tmp_path / str(at)
        assert merged("kill", at, out) == -signal.SIGKILL
        if not (out / "run.json").exists():
            assert merged("count", 0, out) == 0  # what is left of the other is in nobody's way
        assert content(out) == whole
        record = json.loads((out / "run.json").read_text())
        assert all((out / name).is_file() for name in record["files"])
        assert _frames(out / "map" / "map.recon") == 28
