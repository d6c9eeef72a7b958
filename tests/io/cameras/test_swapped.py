"""Calibrations of cameras that are not side by side, left before right, in every format."""

from dataclasses import replace

import numpy as np
import pytest

from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import invert, make_transform
from recon.core.values import StereoCalibration
from recon.io.cameras.calibration import read_calibration
from tests.io.cameras.test_calibrations import WRITERS, rig, write_ros


@pytest.mark.parametrize("form", WRITERS)
def test_a_rig_with_left_and_right_swapped_is_refused_as_a_pair_would_be(form, tmp_path):
    given = rig("none")
    swapped = StereoCalibration(given.right, given.left, invert(given.T_right_left))
    path = tmp_path / "rig_left.yaml"
    if form == "ros":  # whose rectification knows no such rig
        left, right = write_ros(path, given)
        left.rename(tmp_path / "third")
        right.rename(left)
        (tmp_path / "third").rename(right)
    else:
        WRITERS[form](path, swapped)
    with pytest.raises(CalibrationError, match=r"rig_.*right camera is to the left.*swap"):
        read_calibration(path)
    vertical = replace(given, T_right_left=make_transform(np.eye(3), np.array([0.01, -0.12, 0])))
    if form != "ros":
        WRITERS[form](path, vertical)
        with pytest.raises(CalibrationError, match=r"not side by side.*rotate the images"):
            read_calibration(path, 640, 480)
