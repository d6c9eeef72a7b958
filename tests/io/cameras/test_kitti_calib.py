from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.io.cameras.kitti import list_kitti_cameras, read_kitti_calib, read_kitti_offset

SIZE = (1242, 375)


def row(number: int, tx: float, *, focal: float = 700.0, cx: float = 600.0, tz: float = 0.0) -> str:
    """A line ``P = K·[I | t]`` with t = (tx, 0, tz), metres."""
    K = np.array([[focal, 0, cx], [0, focal, 180], [0, 0, 1]])
    P = K @ np.array([[1, 0, 0, tx], [0, 1, 0, 0], [0, 0, 1, tz]])
    return f"P{number}: " + " ".join(f"{value:.12e}" for value in P.ravel()) + "\n"


GREY = row(0, 0) + row(1, -0.5)
COLOUR = row(2, 0.06, tz=0.003) + row(3, -0.47, tz=0.003)


def write(tmp_path: Path, text: str) -> Path:
    (tmp_path / "calib.txt").write_text(text)
    return tmp_path / "calib.txt"


def test_grey_pair_has_the_baseline_of_p1(tmp_path: Path) -> None:
    camera = read_kitti_calib(write(tmp_path, GREY + COLOUR), *SIZE)
    assert (camera.focal_px, camera.cx_px, camera.cy_px, camera.doffs_px) == (700, 600, 180, 0)
    assert (camera.width_px, camera.height_px) == SIZE
    assert camera.baseline_m == pytest.approx(0.5, abs=1e-12)


def test_colour_pair_has_the_baseline_between_its_own_two_cameras(tmp_path: Path) -> None:
    camera = read_kitti_calib(write(tmp_path, GREY + COLOUR), *SIZE, cameras=(2, 3))
    assert camera.baseline_m == pytest.approx(0.53, abs=1e-12)


def test_offset_is_where_camera_0_lies_in_the_camera(tmp_path: Path) -> None:
    T_camera2_camera0 = read_kitti_offset(write(tmp_path, GREY + COLOUR), 2)
    np.testing.assert_allclose(T_camera2_camera0[:3, 3], [0.06, 0, 0.003], atol=1e-12)
    np.testing.assert_array_equal(T_camera2_camera0[:3, :3], np.eye(3))


def test_different_principal_points_become_doffs(tmp_path: Path) -> None:
    camera = read_kitti_calib(write(tmp_path, row(0, 0) + row(1, -0.5, cx=610)), *SIZE)
    assert camera.doffs_px == 10


def test_cameras_of_the_raw_data_are_listed_too(tmp_path: Path) -> None:
    text = "calib_time: 09-Jan-2012\nS_rect_00: 1 2\n" + GREY.replace("P", "P_rect_0")
    path = write(tmp_path, text)
    assert list_kitti_cameras(path) == {0, 1}
    assert read_kitti_calib(path, *SIZE).baseline_m == pytest.approx(0.5)


@pytest.mark.real
def test_real_grey_and_colour_baselines_are_those_of_the_rig(recon_data: Path) -> None:
    path = recon_data / "driven" / "kitti_raw_0013" / "calib.txt"
    assert read_kitti_calib(path, *SIZE).baseline_m == pytest.approx(0.5372, abs=1e-4)
    # 0.5327 m, and neither the 0.47 m of P3 alone nor the grey pair's.
    assert read_kitti_calib(path, *SIZE, cameras=(2, 3)).baseline_m == pytest.approx(
        0.533, abs=1e-3
    )
