"""Calibration files: what each format keeps, what its consumers make of it, and of which images."""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from recon.core.errors import CalibrationError, FormatError, ReconError
from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.core.values import CameraIntrinsics, LensModel, RectifiedCamera, StereoCalibration
from recon.io.cameras import calibration as ours
from recon.io.cameras.calibration import read_calibration, write_opencv_calibration
from recon.io.cameras.kitti import list_kitti_cameras, read_kitti_calib, read_kitti_offset
from recon.io.cameras.ros import write_camera_info, write_kalibr
from recon.io.images.image import write_image
from recon.sources.one_pair import read_pair_input
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from recon.stereo.rectify.rectifier import RectificationSettings, plan_turns
from tests.scenery.boards import board_rig
from tests.sources import drives

Write = Callable[[Path, StereoCalibration], object]

T_RIGHT_LEFT = make_transform(
    exp_so3(np.array([0.01, -0.02, 0.005])), np.array([-0.12, 1e-3, -2e-3])
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


def write_ros(path: Path, calibration: StereoCalibration) -> tuple[Path, Path]:
    turns = plan_turns(calibration, RectificationSettings())
    return write_camera_info(path, calibration, (turns.R_left, turns.R_right), turns.camera)


WRITERS: dict[str, Write] = {
    "recon": ours.write_recon_calibration,
    "opencv": write_opencv_calibration,
    "ros": write_ros,
    "kalibr": write_kalibr,
}
HELD = [(w, n) for w in WRITERS for n in LENSES if w != "kalibr" or n not in {"brown", "rational"}]


@pytest.mark.parametrize(("form", "lens"), HELD)
def test_every_format_gives_the_rig_back_whatever_its_name(tmp_path, form, lens):
    want = rig(lens)
    WRITERS[form](tmp_path / "left_rig.yaml", want)
    have = read_calibration(tmp_path / "left_rig.yaml", 640, 480)
    # ROS tells the pose by two rotations, multiplied: rounding alone.
    np.testing.assert_allclose(have.T_right_left, want.T_right_left, atol=1e-12)
    for got, camera in ((have.left, want.left), (have.right, want.right)):
        np.testing.assert_allclose(got.matrix, camera.matrix, rtol=1e-15)
        padded = np.zeros(got.distortion.size)
        padded[: camera.distortion.size] = camera.distortion
        np.testing.assert_allclose(got.distortion, padded, rtol=1e-15)
        assert (got.model, got.width_px, got.height_px) == (camera.model, 640, 480)


def test_our_file_is_exact_names_every_unit_and_is_believed(tmp_path):
    camera = RectifiedCamera(1 / 3 + 700, 600.1, 180.7, 610.3, 0.54, 1242, 375, ndisp=96)
    ours.write_recon_calibration(tmp_path / "c.yaml", camera)
    assert read_calibration(tmp_path / "c.yaml", camera.width_px, camera.height_px) == camera
    ours.write_recon_calibration(tmp_path / "c.yaml", rig("radtan"), {"stereo_rms_px": 0.25})
    text = (tmp_path / "c.yaml").read_text()
    for word in ("fx_px:", "width_px: 640", "translation_m:", "k1: -0.3", "stereo_rms_px: 0.25"):
        assert word in text
    cropped = replace(CAMERA, cy_px=1.0)
    ours.write_recon_calibration(tmp_path / "crop.yaml", cropped)
    assert read_calibration(tmp_path / "crop.yaml", *RECTIFIED) == cropped


@pytest.mark.parametrize("lens", ["brown", "rational"])
def test_kalibr_refuses_a_lens_that_it_has_no_name_for(tmp_path, lens):
    with pytest.raises(CalibrationError, match=r"kalibr.*pinhole with \d coeff.*radial_terms"):
        write_kalibr(tmp_path / "chain.yaml", rig(lens))
    assert not list(tmp_path.iterdir())


def test_two_models_in_an_opencv_file_and_what_is_no_calibration_are_refused(tmp_path):
    mixed = StereoCalibration(rig("fisheye").left, rig("radtan").right, T_RIGHT_LEFT)
    with pytest.raises(CalibrationError, match="two lens models"):
        write_opencv_calibration(tmp_path / "mixed.yml", mixed)
    ours.write_recon_calibration(tmp_path / "mixed.yaml", mixed)
    assert ours.read_recon_calibration(tmp_path / "mixed.yaml").left.model == "fisheye"
    (tmp_path / "notes.txt").write_text("f = 700\n")
    with pytest.raises(FormatError, match=r"notes\.txt: not.*KITTI.*Middlebury.*OpenCV"):
        read_calibration(tmp_path / "notes.txt", 640, 480)
    (tmp_path / "h.yaml").write_text("note: up to scale\nwidth_px: 64\nH_left:\n- [1, 0, 0]\n")
    with pytest.raises(CalibrationError, match=r"h\.yaml: .*no depth.*recon disparity"):
        read_calibration(tmp_path / "h.yaml", 64, 48)


def swap(left: Path, right: Path) -> None:
    P = yaml.safe_load(right.read_text())["projection_matrix"]["data"]
    right.write_text(right.read_text().replace(repr(P[3]), repr(-P[3])))


def spoil_matrix(side: str, *paths: Path) -> None:
    """Leave the rectification matrix of a camera empty, as drivers do."""
    path = paths[side == "right"]
    content = yaml.safe_load(path.read_text())
    content["rectification_matrix"]["data"] = [0.0] * 9
    path.write_text(yaml.safe_dump(content))


def move(place: int, _: Path, right: Path) -> None:
    """Put the baseline of the right camera at another place of its P."""
    content = yaml.safe_load(right.read_text())
    P = content["projection_matrix"]["data"]
    P[3], P[place] = P[place], P[3]
    right.write_text(yaml.safe_dump(content))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda left, right: right.unlink(), "CameraInfo of the other camera"),
        (shutil.copy, r"CameraInfo has no baseline \(got P\[0, 3\] = 0.*alone.*--calib$"),
        (swap, "to the left of the left.*swap left and right"),
        (
            partial(spoil_matrix, "left"),
            r"R of the left CameraInfo is not a rot.*\(got zeros\); take",
        ),
        (partial(spoil_matrix, "right"), "R of the right CameraInfo is not a rotation"),
        (
            partial(move, 7),
            r"not side by side \(got right camera at \(0, 0.12\d*, 0\) m.*90 degrees",
        ),
    ],
)
def test_camera_infos_that_are_no_rig_are_refused(tmp_path, spoil, message):
    left, right = write_ros(tmp_path / "rig.yaml", rig("brown"))
    spoil(left, right)
    with pytest.raises(ReconError, match=rf"rig_(?:left|right)\.yaml: .*{message}"):
        read_calibration(left, 640, 480)


def test_camera_infos_that_measure_from_another_camera_give_the_same_rig(tmp_path):
    paths = write_ros(tmp_path / "rig.yaml", rig("brown"))
    for path in paths:
        content = yaml.safe_load(path.read_text())
        P = content["projection_matrix"]["data"]
        P[3] += 0.27 * P[0]
        path.write_text(yaml.safe_dump(content))
    have = read_calibration(paths[0], 640, 480)
    np.testing.assert_allclose(have.T_right_left, T_RIGHT_LEFT, atol=1e-12)


def test_camera_infos_of_a_lens_beside_rectified_images_are_refused_with_the_numbers(tmp_path):
    paths = write_ros(tmp_path / "rig.yaml", rig("brown"))
    for path in paths:
        content = yaml.safe_load(path.read_text())
        content["projection_matrix"]["data"][2::4] = 280.0, 190.0, 1.0
        content |= {"image_width": 560, "image_height": 380}
        path.write_text(yaml.safe_dump(content))
    said = "images are rectified.*--focal .* --baseline 0.12.* --cx 280 --cy 190"
    with pytest.raises(CalibrationError, match=rf"rig_left.yaml: .*{said}"):
        read_calibration(paths[0], 560, 380)


@pytest.mark.parametrize("form", ["kalibr", "ros", "yml", "xml", "kitti", "middlebury"])
def test_decimal_commas_in_a_calibration_are_refused_for_what_they_are(tmp_path, form):
    path = tmp_path / f"rig.{form}"
    if form in ("yml", "xml"):
        write_opencv_calibration(path, rig("brown"))
    elif form in ("kitti", "middlebury"):
        path.write_text({"kitti": KITTI, "middlebury": MIDDLEBURY}[form].replace("700", "700.5"))
    else:
        (write_kalibr if form == "kalibr" else write_ros)(path, rig("radtan"))
        path = min(tmp_path.iterdir())
    path.write_text(re.sub(r"(\d)\.(?!0\"?[?\n])", r"\1,", path.read_text()))
    with pytest.raises(FormatError, match="decimals are written with a comma"):
        read_calibration(path, 640, 480)


@pytest.mark.parametrize("write", [write_kalibr, write_ros])
def test_a_header_of_opencv_does_not_hide_the_format(tmp_path, write):
    write(tmp_path / "rig.yaml", rig("radtan"))
    for path in tmp_path.iterdir():
        path.write_text("%YAML:1.0\n---\n" + path.read_text())
    path = min(tmp_path.iterdir())
    assert isinstance(read_calibration(path, 640, 480), StereoCalibration)


# What consumers of the files compute by equations of their own, without our readers.
XYZ = np.random.default_rng(0).uniform((-0.6, -0.4, 1.5), (0.6, 0.4, 4.0), (60, 3))
EXACT = (3, 100, 1e-12)


def seen_by(rig: StereoCalibration) -> list[np.ndarray]:
    """Where each camera sees the points: the truth for every consumer."""
    seen = []
    for camera, xyz in ((rig.left, XYZ), (rig.right, apply(rig.T_right_left, XYZ))):
        project = cv2.fisheye.projectPoints if camera.model == "fisheye" else cv2.projectPoints
        lens = np.array(camera.matrix), np.array(camera.distortion)
        seen.append(project(xyz.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), *lens)[0][:, 0])
    return [pixels.reshape(-1, 2) for pixels in seen]


@pytest.mark.parametrize("lens", ["radtan", "rational"])
def test_opencv_rectifies_by_what_file_storage_reads(tmp_path, lens):
    rig = board_rig(lens)
    write_opencv_calibration(tmp_path / "rig.yml", rig)
    storage = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    M1, D1, M2, D2, R, T = (storage.getNode(n).mat() for n in ("M1", "D1", "M2", "D2", "R", "T"))
    size = tuple(int(storage.getNode(f"image_{side}").real()) for side in ("width", "height"))
    R1, R2, P1, P2, Q, *_ = cv2.stereoRectify(M1, D1, M2, D2, size, R, T, alpha=0)
    left, right = (pixels.reshape(-1, 1, 2) for pixels in seen_by(rig))
    a = cv2.undistortPoints(left, M1, D1, R=R1, P=P1, criteria=EXACT)[:, 0]
    b = cv2.undistortPoints(right, M2, D2, R=R2, P=P2, criteria=EXACT)[:, 0]
    np.testing.assert_allclose(a[:, 1], b[:, 1], atol=1e-4)
    at = np.column_stack([a, a[:, 0] - b[:, 0], np.ones(len(a))]) @ Q.T
    np.testing.assert_allclose(at[:, :3] / at[:, 3:], XYZ @ R1.T, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("lens", "name", "count"),
    [("radtan", "plumb_bob", 5), ("rational", "rational_polynomial", 8),
     ("fisheye", "equidistant", 4)],
)  # fmt: skip
def test_camera_info_rectifies_by_the_equations_of_its_message(tmp_path, lens, name, count):
    """sensor_msgs/CameraInfo: P = K' [I | t], disparity of a point is -P[0, 3] of the right / Z."""
    rig, placed = board_rig(lens), []
    undistort = cv2.fisheye.undistortPoints if lens == "fisheye" else cv2.undistortPoints
    for path, seen in zip(write_ros(tmp_path / "rig.yaml", rig), seen_by(rig), strict=True):
        content = yaml.safe_load(path.read_text())
        K, R, P = (
            np.array(part["data"]).reshape(part["rows"], part["cols"])
            for key in ("camera", "rectification", "projection")
            for part in [content[f"{key}_matrix"]]
        )
        assert (K.shape, R.shape, P.shape) == ((3, 3), (3, 3), (3, 4))
        D = np.array(content["distortion_coefficients"]["data"])
        assert (content["distortion_model"], D.size) == (name, count)
        at = undistort(seen.reshape(-1, 1, 2), K, D, R=R, P=P[:, :3], criteria=EXACT)
        placed.append((at[:, 0], P, R))
    (a, P_left, R_left), (b, P_right, _) = placed
    np.testing.assert_allclose(a[:, 1], b[:, 1], atol=1e-4)
    doffs = P_right[0, 2] - P_left[0, 2]
    depth = -P_right[0, 3] / (a[:, 0] - b[:, 0] + doffs)
    np.testing.assert_allclose(depth, (XYZ @ R_left.T)[:, 2], rtol=1e-4)


@pytest.mark.parametrize(("lens", "name"), [("radtan", "radtan"), ("fisheye", "equidistant")])
def test_a_kalibr_chain_projects_by_the_equations_of_its_wiki(tmp_path, lens, name):
    rig, xyz = board_rig(lens), XYZ
    write_kalibr(tmp_path / "chain.yaml", rig)
    chain = yaml.safe_load((tmp_path / "chain.yaml").read_text())
    for key, seen in zip(("cam0", "cam1"), seen_by(rig), strict=True):
        camera = chain[key]
        assert (camera["camera_model"], camera["distortion_model"]) == ("pinhole", name)
        if "T_cn_cnm1" in camera:
            T = np.array(camera["T_cn_cnm1"])
            xyz = xyz @ T[:3, :3].T + T[:3, 3]
        x, y = xyz[:, 0] / xyz[:, 2], xyz[:, 1] / xyz[:, 2]
        k1, k2, p1, p2 = camera["distortion_coeffs"]
        r2 = x * x + y * y
        if name == "radtan":
            radial = 1 + k1 * r2 + k2 * r2 * r2
            u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        else:
            angle = np.arctan(np.sqrt(r2))
            bent = angle * (1 + k1 * angle**2 + k2 * angle**4 + p1 * angle**6 + p2 * angle**8)
            u, v = x * bent / np.sqrt(r2), y * bent / np.sqrt(r2)
        fu, fv, pu, pv = camera["intrinsics"]
        np.testing.assert_allclose(np.column_stack([fu * u + pu, fv * v + pv]), seen, atol=1e-6)
        assert camera["resolution"] == [640, 480]


LEFT, RIGHT = rig("brown").left.matrix, rig("brown").right.matrix
LENS = np.array(LENSES["brown"][1])
T_MM = 1000 * T_RIGHT_LEFT[:3, 3:]
NODES: dict[str, object] = {"M1": LEFT, "D1": LENS, "M2": RIGHT, "D2": -LENS}
POSE: dict[str, object] = {"R": T_RIGHT_LEFT[:3, :3], "T": T_RIGHT_LEFT[:3, 3:]}
OTHER_NAMES = ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2")


def write_nodes(path: Path, **nodes: object) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in nodes.items():
        if value is not None:
            storage.write(name, np.array(value) if isinstance(value, np.ndarray) else value)
    storage.release()
    return path


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize("names", [tuple(NODES), OTHER_NAMES])
def test_files_of_opencv_are_read_under_all_usual_names(tmp_path, suffix, names):
    nodes = dict(zip(names, NODES.values(), strict=True))
    path = write_nodes(tmp_path / f"stereo.{suffix}", **nodes, **POSE)
    read = read_calibration(path, 640, 480)
    np.testing.assert_allclose(read.right.matrix, RIGHT, rtol=1e-15)
    np.testing.assert_array_equal(read.right.distortion, -LENS)
    np.testing.assert_array_equal(read.T_right_left, T_RIGHT_LEFT)


def test_opencv_files_in_millimetres_and_with_extrinsics_beside_them_are_read(tmp_path):
    path = write_nodes(tmp_path / "stereo.yml", **NODES, **{**POSE, "T": T_MM})
    read = read_calibration(path, 640, 480, metres_per_unit=0.001)
    np.testing.assert_allclose(read.T_right_left, T_RIGHT_LEFT, rtol=1e-14)
    said = r"got 120\.\d+ m.*--set source.metres_per_unit=0.001"
    with pytest.raises(CalibrationError, match=rf"stereo\.yml: baseline is impl.*{said}"):
        read_calibration(path, 640, 480)
    large = read_calibration(path, 640, 480, metres_per_unit=1.0)
    assert isinstance(large, StereoCalibration)
    np.testing.assert_allclose(large.T_right_left[:3, 3], T_MM[:, 0])  # who sets it knows
    path = write_nodes(tmp_path / "intrinsics.yml", **NODES)
    beside = tmp_path / "extrinsics.yml"
    write_nodes(beside, **POSE, P1=np.eye(3, 4), P2=np.eye(3, 4))
    read = read_calibration(path, 640, 480)
    np.testing.assert_array_equal(read.T_right_left, T_RIGHT_LEFT)
    np.testing.assert_array_equal(read_calibration(beside, 640, 480).T_right_left, T_RIGHT_LEFT)


@pytest.mark.parametrize("suffix", ["yml", "json"])
def test_a_file_of_projection_matrices_alone_is_of_rectified_images(tmp_path, suffix):
    P1 = np.array([[570.0, 0, 330, 0], [0, 570, 240, 0], [0, 0, 1, 0]])
    P2 = P1 + np.array([[0, 0, 9, -570 * 4.4], [0, 0, 0, 0], [0, 0, 0, 0]])
    path = write_nodes(tmp_path / f"endoscope.{suffix}", P1=P1, P2=P2, Q=np.eye(4))
    read = read_calibration(path, 640, 480, metres_per_unit=0.001)
    assert read == RectifiedCamera(570.0, 330.0, 240.0, 339.0, read.baseline_m, 640, 480)
    assert read.baseline_m == pytest.approx(0.0044, rel=1e-12)
    with pytest.raises(CalibrationError, match="the calibration is of another size"):
        read_calibration(path, 2560, 1920, metres_per_unit=0.001)
    write_nodes(path, P1=P1, P2=np.diag([1.0, 2.0, 1.0]) @ P2)
    with pytest.raises(CalibrationError, match="P1 and P2 have different focal lengths or rows"):
        read_calibration(path, 640, 480)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"M2": None}, FormatError, "calibration has no two camera matrices.*expected K1 and K2"),
        ({"T": None}, FormatError, "calibration has no pose of the right camera"),
        ({"M1": np.eye(2)}, FormatError, r"no two camera matrices .*M1 \(4 numbers\)"),
        ({"M1": "none"}, FormatError, "calibration has no two camera matrices"),
        ({"D1": np.zeros(7)}, FormatError, r"distortion has the wrong size \(got 7 coefficients"),
        ({"M1": LEFT * np.nan}, CalibrationError, "not finite"),
        ({"M1": -LEFT}, CalibrationError, "focal length is not positive"),
        ({"T": np.zeros((3, 1))}, CalibrationError, "baseline is zero"),
        ({"R": 2 * np.eye(3)}, CalibrationError, "R of the right camera is not a rotation"),
        ({"R": np.zeros((3, 3))}, CalibrationError, "R of the right .*not a rotation .got zeros"),
        ({"R": np.diag([1.0, 1, -1])}, CalibrationError, "R of the right .*not a rotation"),
        ({"image_width": None}, FormatError, "does not contain the image size"),
    ],
)
def test_a_bad_calibration_is_one_clear_line_with_the_file(tmp_path, change, error, message):
    nodes = {**NODES, **POSE, "image_width": 640, "image_height": 480, **change}
    path = write_nodes(tmp_path / "stereo.yml", **nodes)
    with pytest.raises(error, match=rf"stereo\.yml: .*{message}"):
        read_calibration(path)


@pytest.mark.real
def test_the_published_chessboard_calibration_is_read_from_its_two_files(recon_data):
    folder = recon_data / "calibration" / "opencv_chessboard"
    read = read_calibration(folder / "intrinsics.yml", 640, 480)
    assert read.baseline_m == pytest.approx(3.343, abs=1e-3)  # squares of the board
    assert read.left.distortion.size == 14


SIZE = (1242, 375)
KITTI = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -350 0 700 180 0 0 0 1 0\n"
# Cameras 2 and 3 at x = -0.06 and 0.47 m, 3 mm behind the others: P = K·[I | t].
COLOUR = (
    "P2: 700 0 600 43.8 0 700 180 0.54 0 0 1 0.003\nP3: 700 0 600 -327.2 0 700 180 0.54 0 0 1 0.003"
)
MIDDLEBURY = (
    "cam0=[700 0 600; 0 700 180; 0 0 1]\ncam1=[700 0 600; 0 700 180; 0 0 1]\n"
    "doffs=0\nbaseline=500\nwidth=1242\nheight=375\n"
)


@pytest.mark.parametrize("text", [KITTI, MIDDLEBURY, KITTI.replace("P0", "P2").replace("P1", "P3")])
def test_kitti_and_middlebury_files_of_one_rig_give_one_camera(tmp_path, text):
    (tmp_path / "calib.txt").write_text(text)
    want = RectifiedCamera(700, 600, 180, 600, 0.5, *SIZE)
    assert read_calibration(tmp_path / "calib.txt", *SIZE) == want


def test_each_pair_of_a_kitti_rig_has_its_own_baseline_offset_and_doffs(tmp_path):
    path = tmp_path / "calib.txt"
    path.write_text(KITTI + COLOUR)
    assert read_kitti_calib(path, *SIZE).baseline_m == 0.5
    colour = read_kitti_calib(path, *SIZE, cameras=(2, 3))
    assert colour.baseline_m == pytest.approx(0.53, abs=1e-12)
    T_camera2_camera0 = read_kitti_offset(path, 2)
    np.testing.assert_allclose(T_camera2_camera0[:3, 3], [0.06, 0, 0.003], atol=1e-12)
    np.testing.assert_array_equal(T_camera2_camera0[:3, :3], np.eye(3))
    path.write_text(KITTI.replace("600 -350", "610 -350"))
    assert read_kitti_calib(path, *SIZE).doffs_px == 10
    path.write_text("calib_time: 09-Jan-2012\nS_rect_00: 1 2\n" + KITTI.replace("P", "P_rect_0"))
    assert (list_kitti_cameras(path), read_kitti_calib(path, *SIZE).baseline_m) == ({0, 1}, 0.5)


# A calibration is used only for images of its own size; KITTI's raw files have two sizes.
RAW, RECTIFIED = (160, 60), (142, 44)
# Camera n of the raw file is at n half metres, turned a little, and has a focal length of its own.
FOCAL = (98.0, 97.0, 95.0, 94.0)
RAW_LENS = "-0.37 0.2 0.0012 -0.0008 -0.07"
CAMERA = RectifiedCamera(72.0, 70.5, 21.5, 70.5, 0.5, *RECTIFIED)


@pytest.fixture
def kitti_raw(tmp_path):
    """``calib_cam_to_cam.txt`` of four cameras."""
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    for number, focal in enumerate(FOCAL):
        R = " ".join(map(str, exp_so3(np.array([0.01, 0.02, -0.005]) * number).ravel()))
        lines += [
            f"S_0{number}: {RAW[0]:e} {RAW[1]:e}", f"K_0{number}: {focal} 0 81 0 {focal} 29 0 0 1",
            f"D_0{number}: {RAW_LENS}", f"R_0{number}: {R}", f"T_0{number}: {-0.5 * number} 0.01 0",
            f"S_rect_0{number}: {RECTIFIED[0]:e} {RECTIFIED[1]:e}",
            f"R_rect_0{number}: 1 0 0 0 1 0 0 0 1",
            f"P_rect_0{number}: 72 0 70.5 {-36 * number} 0 72 21.5 0 0 0 1 0",
        ]  # fmt: skip
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def write_pair(folder: Path, size: tuple[int, int], names: tuple[str, str]) -> list[Path]:
    images = np.random.default_rng(1).integers(0, 256, (2, *size[::-1]), dtype=np.uint8)
    paths = [folder / name / "000000.png" for name in names]
    for path, image in zip(paths, images, strict=True):
        write_image(path, image)
    return paths


def test_images_get_the_cameras_of_a_kitti_file_that_have_their_size(kitti_raw):
    rig = read_calibration(kitti_raw, *RAW)
    assert (rig.left.matrix[0, 0], rig.right.matrix[0, 0]) == FOCAL[:2]
    assert rig.left.distortion.tolist() == [float(word) for word in RAW_LENS.split()]
    assert (rig.left.width_px, rig.left.height_px) == RAW
    assert read_calibration(kitti_raw, *RECTIFIED) == CAMERA
    message = r"images have another size .*got 80x30, expected 142x44 rectified, or 160x60 raw"
    with pytest.raises(CalibrationError, match=message):
        read_calibration(kitti_raw, 80, 30)


@pytest.mark.parametrize(
    ("kind", "views", "focal"),
    [
        ("folders", ("left", "right"), FOCAL[:2]),
        ("kitti", ("image_0", "image_1"), FOCAL[:2]),
        ("kitti-raw", ("image_00/data", "image_01/data"), FOCAL[:2]),
        ("pair", ("left", "right"), FOCAL[:2]),
        ("folders", ("image_2", "image_3"), FOCAL[2:]),
        ("kitti", ("image_2", "image_3"), FOCAL[2:]),
        ("pair", ("image_2", "image_3"), FOCAL[2:]),
        ("calib.txt", ("image_0", "image_1"), FOCAL[:2]),
    ],
    ids=str,
)
def test_every_way_in_rectifies_raw_kitti_images_with_their_cameras(kitti_raw, kind, views, focal):
    folder = kitti_raw.parent / "drive"
    paths = write_pair(folder, RAW, views)
    (folder / "times.txt").write_text("0\n")
    for path in paths:
        stamps = path.parent.parent / "timestamps.txt"
        stamps.write_text("2011-09-26 13:02:25.000000000\n")
    if kind == "pair":
        rig = read_pair_input(*paths, kitti_raw).calibration
    elif kind == "calib.txt":
        kitti_raw.rename(folder / kind)
        rig = open_source(folder, "kitti").calibration
    else:
        rig = open_source(folder, kind, SourceSettings(calibration=str(kitti_raw))).calibration
    assert (rig.left.matrix[0, 0], rig.right.matrix[0, 0]) == focal


def raw_rig() -> StereoCalibration:
    left = CameraIntrinsics(CAMERA.matrix, np.zeros(4), *RECTIFIED)
    return StereoCalibration(left, left, make_transform(np.eye(3), np.array([-0.5, 0, 0])))


def write_middlebury(path: Path, _: StereoCalibration) -> None:
    K = "[72 0 70.5; 0 72 21.5; 0 0 1]"
    path.write_text(f"cam0={K}\ncam1={K}\ndoffs=0\nbaseline=500\nwidth=142\nheight=44\n")


@pytest.mark.parametrize("write", [write_middlebury, *WRITERS.values()])
def test_every_format_with_a_size_refuses_other_images_when_a_drive_is_opened(tmp_path, write):
    path = tmp_path / "left.yaml"
    write(path, raw_rig())
    pair = write_pair(tmp_path / "drive", (71, 22), ("left", "right"))
    message = r"left\.yaml: images have another size .*got 71x22, expected 142x44"
    with pytest.raises(CalibrationError, match=message):
        open_source(tmp_path / "drive", None, SourceSettings(calibration=str(path)))
    with pytest.raises(CalibrationError, match=message):
        read_pair_input(*pair, path)


@pytest.mark.parametrize("form", ["kitti", "opencv"])
def test_a_file_without_a_size_is_refused_if_its_centre_cannot_be_that_of_the_images(
    tmp_path, form
):
    path = drives.write_calib(tmp_path, CAMERA)
    if form == "opencv":
        write_opencv_calibration(path, raw_rig())
        path.write_text(re.sub(r"image_\w+: \d+\n", "", path.read_text()))
    assert read_calibration(path, *RECTIFIED)
    message = r"another size .*principal point at \(70\.5, 21\.5\) of 71x22 pixels.*stores the size"
    with pytest.raises(CalibrationError, match=message):
        read_calibration(path, 71, 22)


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
