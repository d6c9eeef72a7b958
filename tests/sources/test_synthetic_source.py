"""The synthetic drive behaves like any other source, also after writing it as KITTI."""

from __future__ import annotations

import numpy as np
import pytest

from recon.sources.kitti import open_kitti
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetSettings
from tests.scenery.kitti import write_kitti


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    return SyntheticSource(
        StreetSettings(frames=3, seed=6, width_px=160, height_px=80, focal_px=90.0)
    )


def test_pairs_come_in_order_and_are_repeatable(source):
    pairs = list(source)
    assert repr(source) == "SyntheticSource(synthetic street 6, pairs: 3, a rendered street)"
    assert [pair.index for pair in pairs] == [0, 1, 2]
    assert [pair.timestamp_s for pair in pairs] == pytest.approx([0.0, 0.1, 0.2])
    assert np.array_equal(pairs[1].left, source.frame(1).pair.left)
    assert [pair.index for pair in source.frames(2)] == [2]


def test_truth_has_a_pose_per_frame_and_surfaces(source):
    truth = source.truth
    assert len(truth.trajectory) == 3
    assert truth.surface.frame == "world"
    assert source.truth is truth
    occupancy = source.occupancy_truth(resolution_m=0.5)
    assert occupancy.grid.resolution_m == 0.5
    assert occupancy.seen.any()
    one, two = source.disparity_truth(1), source.frame(1).truth
    assert np.array_equal(one.values, two.values, equal_nan=True)
    assert np.array_equal(one.nonocc, two.nonocc)


@pytest.mark.parametrize("grey", [True, False])
def test_the_kitti_source_reads_the_same_drive(source, tmp_path, grey):
    write_kitti(source, tmp_path / "drive", grey=grey)
    assert (tmp_path / "drive" / "image_0").exists() == grey
    kitti = open_kitti(tmp_path / "drive")
    assert len(kitti) == 3
    for name in ("focal_px", "cx_px", "cy_px", "cx_right_px", "baseline_m"):
        assert getattr(kitti.calibration, name) == pytest.approx(getattr(source.calibration, name))
    true = source.trajectory.T_world_camera
    assert np.allclose(kitti.truth.trajectory.T_world_camera, true, atol=1e-9)
    if not grey:
        assert np.array_equal(next(kitti.frames(2)).left, source.camera.pair(2).left)
