from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.core.errors import CalibrationError, FormatError
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import CameraIntrinsics, RectifiedCamera, StereoCalibration
from recon.io.cameras.calibration import read_calibration
from recon.io.cameras.opencv_yaml import read_opencv_calibration

LEFT = np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]])
RIGHT = np.array([[498.0, 0, 318], [0, 499, 242], [0, 0, 1]])
LENS = np.array([-0.3, 0.1, 1e-3, -2e-3, 0.01])
ROTATION = exp_so3(np.array([0.01, -0.02, 0.005]))
TRANSLATION_M = np.array([-0.12, 0.001, -0.002])


def calibration() -> StereoCalibration:
    return StereoCalibration(
        CameraIntrinsics(LEFT, LENS, 640, 480),
        CameraIntrinsics(RIGHT, -LENS, 640, 480),
        make_transform(ROTATION, TRANSLATION_M),
    )


def write_nodes(path: Path, **nodes: object) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in nodes.items():
        storage.write(name, value)
    storage.release()
    return path


def both_cameras() -> dict[str, object]:
    return {"M1": LEFT, "D1": LENS, "M2": RIGHT, "D2": -LENS}


def pose(scale: float = 1.0) -> dict[str, object]:
    return {"R": ROTATION, "T": TRANSLATION_M.reshape(3, 1) * scale}


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_yaml_xml_and_json_are_read(tmp_path: Path, suffix: str) -> None:
    path = write_nodes(tmp_path / f"stereo.{suffix}", **both_cameras(), **pose())
    read = read_opencv_calibration(path, size_px=(640, 480))
    np.testing.assert_allclose(read.right.matrix, RIGHT, rtol=1e-15)


def test_the_other_usual_names_are_understood(tmp_path: Path) -> None:
    path = write_nodes(
        tmp_path / "stereo.yml",
        cameraMatrix1=LEFT,
        distCoeffs1=LENS,
        cameraMatrix2=RIGHT,
        distCoeffs2=-LENS,
        **pose(),
    )
    np.testing.assert_array_equal(
        read_opencv_calibration(path, size_px=(640, 480)).right.distortion, -LENS
    )


def test_millimetres_become_metres(tmp_path: Path) -> None:
    path = write_nodes(tmp_path / "stereo.yml", **both_cameras(), **pose(1000.0))
    read = read_opencv_calibration(path, size_px=(640, 480), metres_per_unit=0.001)
    np.testing.assert_allclose(read.T_right_left[:3, 3], TRANSLATION_M, rtol=1e-14)


def test_millimetres_taken_for_metres_are_noticed(tmp_path: Path) -> None:
    path = write_nodes(tmp_path / "stereo.yml", **both_cameras(), **pose(1000.0))
    with pytest.raises(
        CalibrationError, match=r"stereo\.yml: baseline is implausibly.*got 120\.\d+ m"
    ):
        read_opencv_calibration(path, size_px=(640, 480))


def test_extrinsics_beside_the_intrinsics_are_found(tmp_path: Path) -> None:
    path = write_nodes(tmp_path / "intrinsics.yml", **both_cameras())
    write_nodes(tmp_path / "extrinsics.yml", **pose())
    read = read_opencv_calibration(path, size_px=(640, 480))
    np.testing.assert_array_equal(read.T_right_left, calibration().T_right_left)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"M2": None}, FormatError, "calibration has no 'M2'.*expected M2 or K2 or cameraMatrix2"),
        ({"T": None}, FormatError, "calibration has no 'T'"),
        ({"M1": np.eye(2)}, FormatError, "'M1' has the wrong size"),
        ({"M1": "none"}, FormatError, "calibration has no 'M1'"),
        ({"D1": np.zeros(7)}, FormatError, r"'D1' has the wrong size \(got 7 coefficients"),
        ({"M1": LEFT * np.nan}, CalibrationError, "not finite"),
        ({"M1": -LEFT}, CalibrationError, "focal length is not positive"),
        ({"T": np.zeros((3, 1))}, CalibrationError, "baseline is zero"),
        ({"R": 2 * np.eye(3)}, CalibrationError, "rotation of the right camera is not orthonormal"),
        ({"image_width": None}, FormatError, "does not contain the image size"),
    ],
)
def test_a_bad_calibration_is_one_clear_line_with_the_file(
    tmp_path: Path, change: dict[str, object], error: type[Exception], message: str
) -> None:
    nodes = {**both_cameras(), **pose(), "image_width": 640, "image_height": 480, **change}
    path = write_nodes(
        tmp_path / "stereo.yml", **{name: node for name, node in nodes.items() if node is not None}
    )
    with pytest.raises(error, match=rf"stereo\.yml: .*{message}"):
        read_opencv_calibration(path)


KITTI = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -350 0 700 180 0 0 0 1 0\n"
MIDDLEBURY = (
    "cam0=[700 0 600; 0 700 180; 0 0 1]\ncam1=[700 0 600; 0 700 180; 0 0 1]\n"
    "doffs=0\nbaseline=500\nwidth=1242\nheight=375\n"
)


@pytest.mark.parametrize("text", [KITTI, MIDDLEBURY, KITTI.replace("P0", "P2").replace("P1", "P3")])
def test_kitti_and_middlebury_files_of_one_rig_give_one_camera(tmp_path: Path, text: str) -> None:
    (tmp_path / "calib.txt").write_text(text)
    want = RectifiedCamera(700, 600, 180, 600, 0.5, 1242, 375)
    assert read_calibration(tmp_path / "calib.txt", 1242, 375) == want


def test_opencv_extrinsics_are_not_taken_for_kitti_although_they_hold_p1(tmp_path: Path) -> None:
    path = write_nodes(tmp_path / "extrinsics.yml", **pose(), P1=np.eye(3, 4), P2=np.eye(3, 4))
    with pytest.raises(FormatError, match=r"extrinsics\.yml: calibration has no 'M1'"):
        read_calibration(path, 640, 480)


def test_what_is_no_calibration_gets_a_list_of_what_is_understood(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("f = 700\n")
    with pytest.raises(FormatError, match=r"notes\.txt: not.*KITTI.*Middlebury.*OpenCV"):
        read_calibration(tmp_path / "notes.txt", 640, 480)


@pytest.mark.real
def test_the_published_chessboard_calibration_is_read_from_its_two_files(recon_data: Path) -> None:
    folder = recon_data / "calibration" / "opencv_chessboard"
    read = read_calibration(folder / "intrinsics.yml", 640, 480)
    assert isinstance(read, StereoCalibration)
    assert read.baseline_m == pytest.approx(3.343, abs=1e-3)  # squares of the board
    assert read.left.distortion.size == 14
