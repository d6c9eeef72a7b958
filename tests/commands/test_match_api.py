"""`recon.match`: two images in, a disparity out, with any matcher."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import recon
from recon.core.errors import FormatError, SettingsError


@pytest.fixture(scope="module")
def pictures() -> tuple[np.ndarray, np.ndarray]:
    """Noise, six pixels further left in the right image."""
    world = np.random.default_rng(8).integers(0, 256, (50, 130), dtype=np.uint8)
    world = cv2.GaussianBlur(world, (3, 3), 0)
    return world[:, :120], world[:, 6:126]


@pytest.mark.parametrize("matcher", ["sad", "sgm", "opencv-bm", "opencv-sgbm"])
def test_every_matcher_finds_the_shift(
    pictures: tuple[np.ndarray, np.ndarray], matcher: str
) -> None:
    disparity = recon.match(*pictures, matcher=matcher, ndisp=16)
    # All fit parts of a pixel; a quarter is more than the bias of any of them.
    assert np.nanmedian(disparity.values) == pytest.approx(6, abs=0.25)
    # OpenCV as it comes leaves out the range at the left and half a window at each other side.
    assert disparity.valid[4:-4, 20:-4].mean() > 0.8


def test_settings_are_those_of_the_matcher_that_is_named(
    pictures: tuple[np.ndarray, np.ndarray],
) -> None:
    assert recon.match(*pictures, matcher="opencv-bm", block_px=15).values.shape == (50, 120)
    with pytest.raises(SettingsError, match="block_px"):
        recon.match(*pictures, block_px=15)
    with pytest.raises(SettingsError, match="unknown matcher"):
        recon.match(*pictures, matcher="nonsense")


CALIBRATIONS = {
    "kitti": "P0: 100 0 60 0 0 100 25 0 0 0 1 0\nP1: 100 0 60 -50 0 100 25 0 0 0 1 0\n",
    "middlebury": "cam0=[100 0 60; 0 100 25; 0 0 1]\ncam1=[100 0 60; 0 100 25; 0 0 1]\n"
    "doffs=0\nbaseline=500\nwidth=120\nheight=50\nndisp=16\n",
    "opencv": "%YAML:1.0\n---\n"
    + "".join(
        f"M{n}: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        "   data: [ 100., 0., 60., 0., 100., 25., 0., 0., 1. ]\n"
        for n in (1, 2)
    )
    + "R: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    "   data: [ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]\n"
    "T: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ -0.5, 0., 0. ]\n",
    "kalibr": "".join(
        f"cam{n}:\n{apart}  camera_model: pinhole\n  intrinsics: [100, 100, 60, 25]\n"
        "  distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n  resolution: [120, 50]\n"
        for n, apart in (
            (0, ""),
            (1, "  T_cn_cnm1: [[1, 0, 0, -0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"),
        )
    ),
}


@pytest.mark.parametrize("kind", CALIBRATIONS)
def test_a_calibration_file_of_any_format_gives_metres(
    pictures: tuple[np.ndarray, np.ndarray], tmp_path: Path, kind: str
) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(CALIBRATIONS[kind])
    frame = recon.reconstruct(*pictures, path)
    # f·b / d = 100 · 0.5 / 6; a quarter of a pixel off, as above, is 4 % of the disparity.
    assert np.median(frame.cloud.xyz[:, 2]) == pytest.approx(100 * 0.5 / 6, rel=0.05)


@pytest.mark.parametrize("kind", ["middlebury", "kalibr"])
def test_a_calibration_with_its_size_needs_no_other(tmp_path: Path, kind: str) -> None:
    (tmp_path / "calib.txt").write_text(CALIBRATIONS[kind])
    assert recon.read_calibration(tmp_path / "calib.txt").baseline_m == pytest.approx(0.5)


@pytest.mark.parametrize("kind", ["kitti", "opencv"])
def test_a_calibration_without_its_size_says_how_to_give_it(tmp_path: Path, kind: str) -> None:
    (tmp_path / "calib.txt").write_text(CALIBRATIONS[kind])
    with pytest.raises(FormatError, match="pass width_px and height_px"):
        recon.read_calibration(tmp_path / "calib.txt")
    assert recon.read_calibration(tmp_path / "calib.txt", 120, 50).baseline_m == pytest.approx(0.5)
