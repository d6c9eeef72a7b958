from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from recon.core.errors import CalibrationError, FormatError
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import CameraIntrinsics, LensModel, RectifiedCamera, StereoCalibration
from recon.io.cameras.calibration import read_calibration
from recon.io.cameras.opencv_yaml import read_opencv_calibration, write_opencv_calibration
from recon.io.cameras.recon_yaml import read_recon_calibration, write_recon_calibration
from recon.io.cameras.ros import (
    camera_info_paths,
    read_camera_info,
    read_kalibr,
    write_camera_info,
    write_kalibr,
)
from recon.stereo.rectify.rectifier import RectificationSettings, plan_turns

T_RIGHT_LEFT = make_transform(
    exp_so3(np.array([0.01, -0.02, 0.005])), np.array([-0.12, 1e-3, 2e-5])
)
LENSES: dict[str, tuple[LensModel, list[float]]] = {
    "none": ("pinhole", []),
    "radtan": ("pinhole", [-0.3, 0.1, 1e-3, -2e-5]),
    "brown": ("pinhole", [-0.3, 0.1, 1e-3, -2e-5, 0.01]),
    "rational": ("pinhole", [0.3, 0.1, 1e-3, -2e-5, 0.01, 0.6, 0.05, 0.001]),
    "fisheye": ("fisheye", [0.02, -0.01, 3e-3, -1e-5]),
}


def rig(lens: str) -> StereoCalibration:
    model, coefficients = LENSES[lens]

    def camera(f: float, cx: float, cy: float) -> CameraIntrinsics:
        matrix = np.array([[f, 0, cx], [0, f * 1.003, cy], [0, 0, 1]])
        return CameraIntrinsics(matrix, np.array(coefficients), 640, 480, model)

    return StereoCalibration(camera(500, 320.25, 240), camera(498, 318, 242.5), T_RIGHT_LEFT)


def write_ros(path: Path, calibration: StereoCalibration) -> None:
    turns = plan_turns(calibration, RectificationSettings())
    write_camera_info(path, calibration, (turns.R_left, turns.R_right), turns.camera)


WRITERS: dict[str, Callable[[Path, StereoCalibration], object]] = {
    "recon": write_recon_calibration,
    "opencv": write_opencv_calibration,
    "ros": write_ros,
    "kalibr": write_kalibr,
}
HELD = [
    (w, lens)
    for w in WRITERS
    for lens in LENSES
    if w != "kalibr" or lens not in {"brown", "rational"}
]


@pytest.mark.parametrize(("form", "lens"), HELD)
def test_every_format_gives_the_rig_back_whatever_its_name(
    tmp_path: Path, form: str, lens: str
) -> None:
    want = rig(lens)
    WRITERS[form](tmp_path / "left_rig.yaml", want)
    have = read_calibration(tmp_path / "left_rig.yaml", 640, 480)
    assert isinstance(have, StereoCalibration)
    # ROS tells the pose by two rotations, multiplied: rounding alone.
    np.testing.assert_allclose(have.T_right_left, want.T_right_left, atol=1e-12)
    for side in ("left", "right"):
        got, camera = getattr(have, side), getattr(want, side)
        np.testing.assert_allclose(got.matrix, camera.matrix, rtol=1e-15)
        padded = np.zeros(got.distortion.size)
        padded[: camera.distortion.size] = camera.distortion
        np.testing.assert_allclose(got.distortion, padded, rtol=1e-15)
        assert (got.model, got.width_px, got.height_px) == (camera.model, 640, 480)


def test_our_file_gives_a_rectified_camera_back_to_the_last_bit(tmp_path: Path) -> None:
    camera = RectifiedCamera(1 / 3 + 700, 600.1, 180.7, 610.3, 0.54, 1242, 375, ndisp=96)
    write_recon_calibration(tmp_path / "c.yaml", camera)
    assert read_calibration(tmp_path / "c.yaml", camera.width_px, camera.height_px) == camera


def test_our_file_names_every_unit_and_keeps_figures_aside(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    write_recon_calibration(path, rig("radtan"), {"stereo_rms_px": 0.25})
    text = path.read_text()
    for word in ("fx_px:", "width_px: 640", "translation_m:", "k1: -0.3", "stereo_rms_px: 0.25"):
        assert word in text


@pytest.mark.parametrize("lens", ["brown", "rational"])
def test_kalibr_refuses_a_lens_that_it_has_no_name_for(tmp_path: Path, lens: str) -> None:
    with pytest.raises(
        CalibrationError, match=r"kalibr.*pinhole with \d coefficients.*radial_terms"
    ):
        write_kalibr(tmp_path / "chain.yaml", rig(lens))
    assert not list(tmp_path.iterdir())


def test_kalibr_chain_as_its_wiki_prints_it_is_read(tmp_path: Path) -> None:
    """The example of kalibr's wiki page "Yaml formats", with a rigid T_cn_cnm1."""
    (tmp_path / "chain.yaml").write_text(
        """cam0:
  camera_model: pinhole
  intrinsics: [461.629, 460.152, 362.680, 246.049]
  distortion_model: radtan
  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]
  resolution: [752, 480]
cam1:
  camera_model: pinhole
  intrinsics: [459.2, 457.7, 362.7, 246.0]
  distortion_model: radtan
  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.110]
  - [0.0, 1.0, 0.0, 1e-05]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  resolution: [752, 480]
"""
    )
    read = read_kalibr(tmp_path / "chain.yaml")
    assert read.left.matrix[0, 0] == 461.629
    assert read.left.width_px == 752
    np.testing.assert_array_equal(read.T_right_left[:3, 3], [-0.11, 1e-5, 0])


@pytest.mark.parametrize(
    ("given", "names"),
    [
        ("rig.yaml", ("rig_left.yaml", "rig_right.yaml")),
        ("left.yaml", ("left.yaml", "right.yaml")),
        ("my_right_cam.yaml", ("my_left_cam.yaml", "my_right_cam.yaml")),
    ],
)
def test_camera_info_files_are_reported_by_left_and_right(
    given: str, names: tuple[str, str]
) -> None:
    assert tuple(path.name for path in camera_info_paths(given)) == names


def test_camera_info_without_its_other_half_says_which_is_missing(tmp_path: Path) -> None:
    write_ros(tmp_path / "rig.yaml", rig("brown"))
    (tmp_path / "rig_right.yaml").unlink()
    with pytest.raises(FormatError, match=r"rig_right\.yaml: CameraInfo of the other camera"):
        read_calibration(tmp_path / "rig_left.yaml", 640, 480)


def test_camera_info_of_two_single_calibrations_is_refused(tmp_path: Path) -> None:
    write_ros(tmp_path / "rig.yaml", rig("brown"))
    (tmp_path / "rig_right.yaml").write_text((tmp_path / "rig_left.yaml").read_text())
    with pytest.raises(
        CalibrationError,
        match=r"rig_right\.yaml: CameraInfo has no baseline \(got P\[0, 3\] = 0.*alone.*--calib$",
    ):
        read_camera_info(tmp_path / "rig_left.yaml")


def test_camera_info_of_swapped_cameras_says_so(tmp_path: Path) -> None:
    write_ros(tmp_path / "rig.yaml", rig("brown"))
    left, right = (tmp_path / f"rig_{side}.yaml" for side in ("left", "right"))
    P = yaml.safe_load(right.read_text())["projection_matrix"]["data"]
    right.write_text(right.read_text().replace(repr(P[3]), repr(-P[3])))
    with pytest.raises(CalibrationError, match=r"to the left of the left.*swap left and right"):
        read_camera_info(left)


@pytest.mark.parametrize("write", [write_kalibr, write_ros])
def test_a_header_of_opencv_does_not_hide_the_format(
    tmp_path: Path, write: Callable[[Path, StereoCalibration], object]
) -> None:
    write(tmp_path / "rig.yaml", rig("radtan"))
    for path in tmp_path.iterdir():
        path.write_text("%YAML:1.0\n---\n" + path.read_text())
    path = min(tmp_path.iterdir())
    assert isinstance(read_calibration(path, 640, 480), StereoCalibration)


def test_an_opencv_file_says_that_it_is_of_a_fisheye_and_refuses_two_models(tmp_path: Path) -> None:
    write_opencv_calibration(tmp_path / "f.yml", rig("fisheye"))
    assert read_opencv_calibration(tmp_path / "f.yml").right.model == "fisheye"
    mixed = StereoCalibration(rig("fisheye").left, rig("radtan").right, T_RIGHT_LEFT)
    with pytest.raises(CalibrationError, match="two lens models"):
        write_opencv_calibration(tmp_path / "mixed.yml", mixed)
    write_recon_calibration(tmp_path / "mixed.yaml", mixed)
    assert read_recon_calibration(tmp_path / "mixed.yaml").left.model == "fisheye"


def test_homographies_are_distinguished_from_a_calibration(tmp_path: Path) -> None:
    path = tmp_path / "homographies.yaml"
    path.write_text("note: up to scale\nwidth_px: 64\nH_left:\n- [1, 0, 0]\n")
    with pytest.raises(CalibrationError, match=r"homographies\.yaml: .*no depth.*recon disparity"):
        read_calibration(path, 64, 48)
