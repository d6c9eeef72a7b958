"""A slower matcher for the views of a drive that show something new."""

import shutil

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import ReconError
from recon.core.progress import showing
from recon.sources.registry import open_source
from recon.stereo.match import registry
from recon.stereo.match.sgm import SgmMatcher
from tests.flow.runs import Breaks, content
from tests.scenery.kitti import street_drive

FRAMES = 12
SLOW = "matching.keyframe_matcher=sgm"


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return street_drive(tmp_path_factory.mktemp("drive"), FRAMES, 192)


@pytest.fixture
def matched(monkeypatch):
    """The numbers of the frames that are matched by `sgm`."""
    seen = []

    class Counted(SgmMatcher):
        def match(self, pair):
            seen.append(pair.index)
            return super().match(pair)

    monkeypatch.setitem(registry.MATCHERS, "sgm", Counted)
    return seen


def _run(drive, out, *settings, progress=None, **more):
    usual = ("checkpoints.every_frames=4", "submaps.length_m=4", "submaps.tile_m=25.6")
    options = MapOptions(audit=False, out=out, mesh=False, **more)
    with showing(progress or Breaks()):
        return run_map(open_source(drive), load_config(None, [*usual, *settings]), options)


def test_views_that_show_something_new_are_matched_again(drive, matched, tmp_path):
    plain = _run(drive, tmp_path / "plain")
    assert matched == []
    run = _run(drive, tmp_path / "again", SLOW)
    assert matched[0] == 0
    assert matched == sorted(set(matched))
    assert 1 < len(matched) < FRAMES
    # Odometry sees what it saw, and the map has more of it.
    path, same = run.mapped.trajectory.T_world_camera, plain.mapped.trajectory.T_world_camera
    assert np.array_equal(path, same)
    assert run.summary.to_json()["voxels"] > plain.summary.to_json()["voxels"]


def test_a_car_that_stands_is_matched_again_once(drive, matched, tmp_path):
    standing = shutil.copytree(drive, tmp_path / "standing")
    for image in standing.glob("image_?/*.png"):
        shutil.copy(drive / image.parent.name / "000000.png", image)
    _run(standing, tmp_path / "run", SLOW)
    assert matched == [0]


def test_an_interrupted_run_goes_on_to_the_same_files(drive, tmp_path):
    _run(drive, tmp_path / "unbroken", SLOW, threads=1)
    for number, frame in enumerate((5, 9)):
        with pytest.raises(KeyboardInterrupt):
            _run(drive, tmp_path / "run", SLOW, progress=Breaks(frame), resume=number > 0)
    _run(drive, tmp_path / "run", SLOW, resume=True)
    assert content(tmp_path / "run") == content(tmp_path / "unbroken")


def test_a_matcher_that_does_not_exist_is_named(drive, tmp_path):
    with pytest.raises(ReconError, match="nosuch"):
        _run(drive, tmp_path / "run", "matching.keyframe_matcher=nosuch")
    assert list(tmp_path.iterdir()) == []
