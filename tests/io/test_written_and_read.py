"""What the public writers write, the public readers read back; what they would not is refused."""

import numpy as np
import pytest

import recon
from recon.core.errors import CalibrationError, FormatError, OutputError
from recon.core.geometry.se3 import invert
from recon.io.trajectory import reordered, write_tum
from tests.io.cameras.test_calibrations import rig
from tests.io.test_trajectory_files import STANDING, carried, crabbing, drive

ODD = reordered(reordered(reordered(drive())))
"""A path that looks as if its quaternions were in the other order."""
PATHS = [drive(), STANDING, crabbing(1.5), ODD, *map(carried, range(3)), drive().select(slice(1))]


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("form", ["tum", "kitti"])
def test_a_trajectory_is_read_back_whatever_it_is(tmp_path, path, form):
    recon.write_trajectory(tmp_path / "a" / "poses.txt", path, form)
    times_s = path.timestamps_s if form == "kitti" else None
    back = recon.read_trajectory(tmp_path / "a" / "poses.txt", times_s)
    np.testing.assert_allclose(back.T_world_camera, path.T_world_camera, atol=1e-9)
    np.testing.assert_allclose(back.timestamps_s, path.timestamps_s, atol=1e-6)


def test_without_its_first_line_an_odd_path_is_not_believed(tmp_path):
    write_tum(tmp_path / "poses.txt", ODD)
    with pytest.raises(FormatError, match="not in the order of TUM"):
        recon.read_trajectory(tmp_path / "poses.txt")


@pytest.mark.parametrize(
    ("path", "form", "said"),
    [
        (drive(), "euroc", r"unknown format.*euroc.*tum or kitti"),
        (drive().select(slice(0)), "tum", "has no pose"),
    ],
)
def test_a_trajectory_that_nobody_could_read_is_not_written(tmp_path, path, form, said):
    with pytest.raises(OutputError, match=said):
        recon.write_trajectory(tmp_path / "poses.txt", path, form)
    assert not [*tmp_path.iterdir()]


def test_a_calibration_that_would_be_refused_is_not_written(tmp_path):
    given = rig("none")
    swapped = recon.StereoCalibration(given.right, given.left, invert(given.T_right_left))
    with pytest.raises(CalibrationError, match=r"rig\.yaml: right camera is to the left"):
        recon.write_calibration(tmp_path / "rig.yaml", swapped)
    assert not [*tmp_path.iterdir()]
