"""The synthetic drive behaves like any other source, also after writing it as KITTI."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from recon.core.errors import OutputError
from recon.sources.kitti import open_kitti
from recon.sources.source import SourcePart, StereoSource
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetSettings
from tests.scenery.kitti import write_kitti


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    return SyntheticSource(
        StreetSettings(frames=3, seed=6, width_px=160, height_px=80, focal_px=90.0)
    )


@pytest.fixture(scope="module")
def written(source, tmp_path_factory):
    folder = tmp_path_factory.mktemp("kitti")
    write_kitti(source, folder)
    return folder


def test_it_is_a_stereo_source(source):
    assert isinstance(source, StereoSource)
    assert repr(source) == "SyntheticSource(synthetic street 6, pairs: 3, a rendered street)"
    part = "SourcePart(synthetic street 6 0 to 1, pairs: 2, a rendered street)"
    assert repr(SourcePart(source, 0, 2)) == part
    assert len(source) == 3
    assert source.calibration.width_px == 160


def test_pairs_come_in_order_and_are_repeatable(source):
    pairs = list(source)
    assert [pair.index for pair in pairs] == [0, 1, 2]
    assert [pair.timestamp_s for pair in pairs] == pytest.approx([0.0, 0.1, 0.2])
    assert np.array_equal(pairs[1].left, source.frame(1).pair.left)


def test_truth_has_a_pose_per_frame_and_a_surface(source):
    truth = source.truth
    assert truth.trajectory is not None
    assert truth.surface is not None
    assert len(truth.trajectory) == 3
    assert truth.surface.frame == "world"
    assert source.truth is truth


def test_disparity_truth_is_that_of_the_frame(source):
    one, two = source.disparity_truth(1), source.frame(1).truth
    assert np.array_equal(one.values, two.values, equal_nan=True)
    assert np.array_equal(one.nonocc, two.nonocc)


def test_occupancy_truth_covers_what_was_seen(source):
    truth = source.occupancy_truth(resolution_m=0.5)
    assert truth.grid.resolution_m == 0.5
    assert truth.seen.any()


def test_the_kitti_layout_reads_back_with_plain_tools(source, written):
    pair = source.camera.pair(2)
    left = cv2.imread(str(written / "image_2" / "000002.png"))
    right = cv2.imread(str(written / "image_3" / "000002.png"))
    assert np.array_equal(left[:, :, ::-1], pair.left)
    assert np.array_equal(right[:, :, ::-1], pair.right)
    poses = np.loadtxt(written / "poses.txt").reshape(-1, 3, 4)
    assert np.allclose(poses, source.trajectory.T_world_camera[:, :3], atol=1e-9)
    assert np.allclose(np.loadtxt(written / "times.txt"), [0.0, 0.1, 0.2])


def test_grey_images_are_the_weighted_colours(source, written):
    grey = cv2.imread(str(written / "image_0" / "000000.png"), cv2.IMREAD_UNCHANGED)
    expected = cv2.cvtColor(source.camera.pair(0).left, cv2.COLOR_RGB2GRAY)
    # OpenCV rounds its weights to 14 bits.
    assert np.abs(grey.astype(int) - expected).max() <= 1


@pytest.mark.parametrize("grey", [True, False])
def test_the_kitti_source_reads_the_same_drive(source, tmp_path, grey):
    write_kitti(source, tmp_path / "drive", grey=grey)
    assert (tmp_path / "drive" / "image_0").exists() == grey
    kitti = open_kitti(tmp_path / "drive")
    assert len(kitti) == 3
    for name in ("focal_px", "cx_px", "cy_px", "cx_right_px", "baseline_m"):
        assert getattr(kitti.calibration, name) == pytest.approx(getattr(source.calibration, name))
    assert kitti.truth is not None
    assert kitti.truth.trajectory is not None
    true = source.trajectory.T_world_camera
    assert np.allclose(kitti.truth.trajectory.T_world_camera, true, atol=1e-9)


def test_a_folder_that_cannot_be_made_is_our_error(source, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError):
        write_kitti(source, tmp_path / "file" / "drive")
