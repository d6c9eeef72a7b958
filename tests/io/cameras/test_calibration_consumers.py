"""Written calibrations, applied by the equations of their consumers, without our readers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from recon.core.geometry.se3 import apply
from recon.core.values import StereoCalibration
from recon.io.cameras.opencv_yaml import write_opencv_calibration
from recon.io.cameras.ros import write_camera_info, write_kalibr
from recon.stereo.rectify.rectifier import RectificationSettings, plan_turns
from tests.scenery.boards import Lens, board_rig

XYZ = np.random.default_rng(0).uniform((-0.6, -0.4, 1.5), (0.6, 0.4, 4.0), (60, 3))


def pixels_of(xyz: np.ndarray, K: np.ndarray, D: np.ndarray, *, fisheye: bool) -> np.ndarray:
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    seen = project(xyz.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, D)[0]
    return np.asarray(seen).reshape(-1, 2)


def rig_of(lens: Lens) -> tuple[StereoCalibration, np.ndarray, np.ndarray]:
    """A rig, and where it sees the points: the truth for every consumer."""
    rig, fisheye = board_rig(lens), lens == "fisheye"
    seen = [
        pixels_of(xyz, np.array(c.matrix), np.array(c.distortion), fisheye=fisheye)
        for c, xyz in ((rig.left, XYZ), (rig.right, apply(rig.T_right_left, XYZ)))
    ]
    return rig, seen[0], seen[1]


@pytest.mark.parametrize("lens", ["radtan", "rational"])
def test_opencv_rectifies_by_what_file_storage_reads(tmp_path: Path, lens: Lens) -> None:
    rig, left, right = rig_of(lens)
    write_opencv_calibration(tmp_path / "rig.yml", rig)
    storage = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    M1, D1, M2, D2, R, T = (
        storage.getNode(name).mat() for name in ("M1", "D1", "M2", "D2", "R", "T")
    )
    size = tuple(int(storage.getNode(f"image_{side}").real()) for side in ("width", "height"))
    R1, R2, P1, P2, Q, *_ = cv2.stereoRectify(M1, D1, M2, D2, size, R, T, alpha=0)
    exact = (3, 100, 1e-12)
    a = cv2.undistortPoints(left.reshape(-1, 1, 2), M1, D1, R=R1, P=P1, criteria=exact)[:, 0]
    b = cv2.undistortPoints(right.reshape(-1, 1, 2), M2, D2, R=R2, P=P2, criteria=exact)[:, 0]
    np.testing.assert_allclose(a[:, 1], b[:, 1], atol=1e-4)
    at = np.column_stack([a, a[:, 0] - b[:, 0], np.ones(len(a))]) @ Q.T
    np.testing.assert_allclose(at[:, :3] / at[:, 3:], XYZ @ R1.T, rtol=1e-3, atol=1e-4)


def info(path: Path) -> dict[str, Any]:
    content = yaml.safe_load(path.read_text())
    for name, shape in (
        ("camera_matrix", (3, 3)),
        ("rectification_matrix", (3, 3)),
        ("projection_matrix", (3, 4)),
    ):
        part = content[name]
        assert (part["rows"], part["cols"]) == shape
        content[name] = np.array(part["data"]).reshape(shape)
    content["D"] = np.array(content["distortion_coefficients"]["data"])
    return dict(content)


@pytest.mark.parametrize(
    ("lens", "name", "count"),
    [
        ("radtan", "plumb_bob", 5),
        ("rational", "rational_polynomial", 8),
        ("fisheye", "equidistant", 4),
    ],
)
def test_camera_info_rectifies_by_the_equations_of_its_message(
    tmp_path: Path, lens: Lens, name: str, count: int
) -> None:
    """sensor_msgs/CameraInfo: P = K' [I | t], disparity of a point is -P[0, 3] of the right / Z."""
    rig, left, right = rig_of(lens)
    turns = plan_turns(rig, RectificationSettings())
    paths = write_camera_info(
        tmp_path / "rig.yaml", rig, (turns.R_left, turns.R_right), turns.camera
    )
    placed = []
    for path, seen in zip(paths, (left, right), strict=True):
        camera = info(path)
        assert camera["distortion_model"] == name
        assert camera["D"].size == count
        undistort = cv2.fisheye.undistortPoints if lens == "fisheye" else cv2.undistortPoints
        P, R = camera["projection_matrix"], camera["rectification_matrix"]
        points = undistort(
            seen.reshape(-1, 1, 2), camera["camera_matrix"], camera["D"], R=R, P=P[:, :3],
            criteria=(3, 100, 1e-12),
        )  # fmt: skip
        placed.append((points[:, 0], P, R))
    (a, P_left, R_left), (b, P_right, _) = placed
    np.testing.assert_allclose(a[:, 1], b[:, 1], atol=1e-4)
    depth = (XYZ @ R_left.T)[:, 2]
    doffs = P_right[0, 2] - P_left[0, 2]
    np.testing.assert_allclose(-P_right[0, 3] / (a[:, 0] - b[:, 0] + doffs), depth, rtol=1e-4)


@pytest.mark.parametrize(("lens", "name"), [("radtan", "radtan"), ("fisheye", "equidistant")])
def test_a_kalibr_chain_projects_by_the_equations_of_its_wiki(
    tmp_path: Path, lens: Lens, name: str
) -> None:
    rig, left, right = rig_of(lens)
    write_kalibr(tmp_path / "chain.yaml", rig)
    chain = yaml.safe_load((tmp_path / "chain.yaml").read_text())
    xyz = XYZ
    for key, seen in (("cam0", left), ("cam1", right)):
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
