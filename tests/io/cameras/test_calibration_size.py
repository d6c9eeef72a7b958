"""A calibration is used only for images of its own size; KITTI's raw files have two sizes."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import CameraIntrinsics, RectifiedCamera, StereoCalibration
from recon.io.cameras.calibration import read_calibration
from recon.io.cameras.opencv_yaml import write_opencv_calibration
from recon.io.cameras.recon_yaml import write_recon_calibration
from recon.io.cameras.ros import write_camera_info, write_kalibr
from recon.io.images.image import write_image
from recon.sources.one_pair import read_pair_input
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from tests.sources import drives

RAW, RECTIFIED = (160, 60), (142, 44)
# Camera n of the raw file is at n half metres, turned a little, and has a focal length of its own.
FOCAL = (98.0, 97.0, 95.0, 94.0)
LENS = "-0.37 0.2 0.0012 -0.0008 -0.07"
CAMERA = RectifiedCamera(72.0, 70.5, 21.5, 70.5, 0.5, *RECTIFIED)


def kitti_raw_text() -> str:
    """``calib_cam_to_cam.txt`` of four cameras."""
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    for number, focal in enumerate(FOCAL):
        K = f"{focal} 0 81 0 {focal} 29 0 0 1"
        R = " ".join(map(str, exp_so3(np.array([0.01, 0.02, -0.005]) * number).ravel()))
        P = f"72 0 70.5 {-36 * number} 0 72 21.5 0 0 0 1 0"
        lines += [
            f"S_0{number}: {RAW[0]:e} {RAW[1]:e}", f"K_0{number}: {K}", f"D_0{number}: {LENS}",
            f"R_0{number}: {R}", f"T_0{number}: {-0.5 * number} 0.01 0",
            f"S_rect_0{number}: {RECTIFIED[0]:e} {RECTIFIED[1]:e}",
            f"R_rect_0{number}: 1 0 0 0 1 0 0 0 1", f"P_rect_0{number}: {P}",
        ]  # fmt: skip
    return "\n".join(lines) + "\n"


@pytest.fixture
def kitti_raw(tmp_path: Path) -> Path:
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text(kitti_raw_text())
    return path


def write_pair(folder: Path, size: tuple[int, int], names: tuple[str, str]) -> tuple[Path, Path]:
    width, height = size
    images = np.random.default_rng(1).integers(0, 256, (2, height, width), dtype=np.uint8)
    paths = tuple(folder / name / "000000.png" for name in names)
    for path, image in zip(paths, images, strict=True):
        write_image(path, image)
    return paths[0], paths[1]


def test_raw_images_get_the_raw_cameras_of_a_kitti_file(kitti_raw: Path) -> None:
    rig = read_calibration(kitti_raw, *RAW)
    assert isinstance(rig, StereoCalibration)
    assert (rig.left.matrix[0, 0], rig.right.matrix[0, 0]) == FOCAL[:2]
    assert rig.left.distortion.tolist() == [float(word) for word in LENS.split()]
    assert (rig.left.width_px, rig.left.height_px) == RAW


def test_rectified_images_get_the_rectified_camera_of_a_kitti_file(kitti_raw: Path) -> None:
    assert read_calibration(kitti_raw, *RECTIFIED) == CAMERA


def test_images_of_neither_size_are_refused_with_both_sizes(kitti_raw: Path) -> None:
    message = r"images have another size .*got 80x30, expected 142x44 rectified, or 160x60 raw"
    with pytest.raises(CalibrationError, match=message):
        read_calibration(kitti_raw, 80, 30)


@pytest.mark.parametrize("kind", ["folders", "kitti", "kitti-raw", "pair"])
def test_every_way_in_rectifies_raw_kitti_images(kitti_raw: Path, kind: str) -> None:
    names = {"kitti": ("image_0", "image_1"), "kitti-raw": ("image_00/data", "image_01/data")}
    views = names.get(kind, ("left", "right"))
    paths = write_pair(kitti_raw.parent, RAW, views)
    if kind == "pair":
        rig = read_pair_input(*paths, kitti_raw).calibration
    else:
        (kitti_raw.parent / "times.txt").write_text("0\n")
        for path in paths:
            stamps = path.parent.parent / "timestamps.txt"
            stamps.write_text("2011-09-26 13:02:25.000000000\n")
        settings = SourceSettings(calibration=str(kitti_raw))
        rig = open_source(kitti_raw.parent, kind, settings).calibration
    assert isinstance(rig, StereoCalibration)
    assert rig.left.matrix[0, 0] == FOCAL[0]


def test_a_kitti_drive_whose_calib_txt_is_the_raw_file_is_rectified(kitti_raw: Path) -> None:
    write_pair(kitti_raw.parent, RAW, ("image_0", "image_1"))
    (kitti_raw.parent / "times.txt").write_text("0\n")
    kitti_raw.rename(kitti_raw.with_name("calib.txt"))
    assert isinstance(open_source(kitti_raw.parent, "kitti").calibration, StereoCalibration)


@pytest.mark.parametrize("kind", ["folders", "kitti", "pair"])
def test_folders_of_the_colour_cameras_get_the_colour_cameras(kitti_raw: Path, kind: str) -> None:
    drive = kitti_raw.parent / "drive"
    paths = write_pair(drive, RAW, ("image_2", "image_3"))
    (drive / "times.txt").write_text("0\n")
    if kind == "pair":
        rig = read_pair_input(*paths, kitti_raw).calibration
    else:
        settings = SourceSettings(calibration=str(kitti_raw), left="image_2", right="image_3")
        rig = open_source(drive, kind, settings).calibration
    assert isinstance(rig, StereoCalibration)
    assert (rig.left.matrix[0, 0], rig.right.matrix[0, 0]) == FOCAL[2:]


def raw_rig() -> StereoCalibration:
    left = CameraIntrinsics(CAMERA.matrix, np.zeros(4), *RECTIFIED)
    return StereoCalibration(left, left, make_transform(np.eye(3), np.array([-0.5, 0, 0])))


def middlebury(folder: Path) -> Path:
    K = "[72 0 70.5; 0 72 21.5; 0 0 1]"
    lines = [f"cam0={K}", f"cam1={K}", "doffs=0", "baseline=500", "width=142", "height=44"]
    path = folder / "calib.txt"
    path.write_text("\n".join(lines))
    return path


def opencv(folder: Path) -> Path:
    write_opencv_calibration(folder / "rig.yml", raw_rig())
    return folder / "rig.yml"


def kalibr(folder: Path) -> Path:
    write_kalibr(folder / "camchain.yaml", raw_rig())
    return folder / "camchain.yaml"


def ours(folder: Path) -> Path:
    write_recon_calibration(folder / "rig.yaml", raw_rig())
    return folder / "rig.yaml"


def camera_info(folder: Path) -> Path:
    turns = (np.eye(3), np.eye(3))
    return write_camera_info(folder / "rig.yaml", raw_rig(), turns, CAMERA)[0]


SIZED = [middlebury, opencv, kalibr, ours, camera_info]


@pytest.mark.parametrize("write", SIZED)
def test_every_format_with_a_size_refuses_other_images_when_a_drive_is_opened(
    tmp_path: Path, write: Callable[[Path], Path]
) -> None:
    calibration = write(tmp_path)
    paths = write_pair(tmp_path / "drive", (71, 22), ("left", "right"))
    message = rf"{calibration.name}: images have another size .*got 71x22, expected 142x44"
    with pytest.raises(CalibrationError, match=message):
        open_source(tmp_path / "drive", None, SourceSettings(calibration=str(calibration)))
    with pytest.raises(CalibrationError, match=message):
        read_pair_input(*paths, calibration)


def kitti_without_size(folder: Path) -> Path:
    return drives.write_calib(folder, CAMERA)


def opencv_without_size(folder: Path) -> Path:
    path = opencv(folder)
    path.write_text(re.sub(r"image_\w+: \d+\n", "", path.read_text()))
    return path


@pytest.mark.parametrize("write", [kitti_without_size, opencv_without_size])
def test_a_file_without_a_size_is_refused_if_its_centre_cannot_be_that_of_the_images(
    tmp_path: Path, write: Callable[[Path], Path]
) -> None:
    calibration = write(tmp_path)
    assert read_calibration(calibration, *RECTIFIED)
    message = r"another size .*principal point at \(70\.5, 21\.5\) of 71x22 pixels.*stores the size"
    with pytest.raises(CalibrationError, match=message):
        read_calibration(calibration, 71, 22)


def test_a_stated_size_is_believed_however_far_off_the_centre_is(tmp_path: Path) -> None:
    cropped = replace(CAMERA, cy_px=1.0)
    write_recon_calibration(tmp_path / "crop.yaml", cropped)
    assert read_calibration(tmp_path / "crop.yaml", *RECTIFIED) == cropped
