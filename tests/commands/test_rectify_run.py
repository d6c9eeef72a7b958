from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.commands.cameras import run_rectify
from recon.commands.config import load_config
from recon.core.errors import CalibrationError
from recon.core.values import RectifiedCamera
from recon.io.cameras.calibration import read_calibration
from recon.io.cameras.recon_yaml import write_recon_calibration
from recon.io.images.image import read_image, write_image
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.boards import board_rig

SMALL = StreetScene(frames=2, width_px=480, height_px=240, focal_px=280.0, smooth_edges=False)
WARP = np.array([[1.0, 0.04, -12], [-0.05, 1.02, 9], [4e-5, -3e-5, 1]])


@pytest.fixture(scope="session")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two pairs of the street; the right camera's are warped by one homography."""
    folder = tmp_path_factory.mktemp("street")
    source = SyntheticSource(SMALL)
    for pair in source:
        height, width = pair.left.shape[:2]
        write_image(folder / "left" / f"{pair.index}.png", pair.left)
        warped = cv2.warpPerspective(pair.right, WARP, (width, height))
        write_image(folder / "right" / f"{pair.index}.png", warped)
    return folder


def test_a_folder_is_rectified_by_its_features_and_says_up_to_scale(
    street: Path, tmp_path: Path
) -> None:
    sides = (str(street / "left"), str(street / "right"))
    run_rectify(*sides, load_config(), out=tmp_path / "out", threads=1)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["up_to_scale"] is True
    assert summary["row_error_px"] < 0.7
    assert any("no metres" in line for line in summary["warnings"])
    assert not (tmp_path / "out" / "calibration.yaml").exists()
    names = {
        path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*")
    }
    assert {"left/0.png", "left/1.png", "right/0.png", "right/1.png"} <= names
    assert {"homographies.yaml", "pictures/epipolar_raw.png"} <= names
    source = SyntheticSource(SMALL)
    truth = source.disparity_truth(0).values
    v, u = np.nonzero(np.isfinite(truth))
    ones = np.ones(len(u))
    left = np.array(summary["H_left"]) @ np.stack([u, v, ones])
    right = np.array(summary["H_right"]) @ WARP @ np.stack([u - truth[v, u], v, ones])
    assert np.abs(left[1] / left[2] - right[1] / right[2]).mean() < 0.7


def test_a_calibration_gives_metric_pictures_that_other_commands_take(
    street: Path, tmp_path: Path
) -> None:
    height, width = read_image(street / "left" / "0.png").shape[:2]
    rig = board_rig("fisheye", width, height)
    write_recon_calibration(tmp_path / "rig.yaml", rig)
    rig_file, out = tmp_path / "rig.yaml", tmp_path / "out"
    sides = (str(street / "left" / "0.png"), str(street / "right" / "0.png"))
    run = run_rectify(*sides, load_config(), calibration=rig_file, out=out, threads=1)
    camera = read_calibration(tmp_path / "out" / "calibration.yaml", width, height)
    assert isinstance(camera, RectifiedCamera)
    assert camera.baseline_m == pytest.approx(rig.baseline_m)
    assert run.summary["up_to_scale"] is False
    assert read_image(tmp_path / "out" / "left" / "0.png").shape == (height, width, 3)


def test_a_calibration_of_rectified_pictures_is_refused(street: Path, tmp_path: Path) -> None:
    camera = RectifiedCamera(270, 240, 120, 240, 0.5, 480, 240)
    write_recon_calibration(tmp_path / "c.yaml", camera)
    sides, file = (str(street / "left"), str(street / "right")), tmp_path / "c.yaml"
    with pytest.raises(CalibrationError, match=r"c\.yaml: .*already rectified"):
        run_rectify(*sides, load_config(), calibration=file, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_blank_pictures_are_one_clear_line(tmp_path: Path) -> None:
    for side in ("l", "r"):
        write_image(tmp_path / f"{side}.png", np.full((100, 120), 80, np.uint8))
    sides = (str(tmp_path / "l.png"), str(tmp_path / "r.png"))
    with pytest.raises(CalibrationError, match="too few matched features"):
        run_rectify(*sides, load_config(), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_one_pair_is_enough_with_features_and_keeps_its_file_type(
    street: Path, tmp_path: Path
) -> None:
    for side in ("left", "right"):
        write_image(tmp_path / side / "0.jpg", read_image(street / side / "0.png"))
    sides = (str(tmp_path / "left" / "0.jpg"), str(tmp_path / "right" / "0.jpg"))
    run = run_rectify(*sides, load_config(), out=tmp_path / "out", threads=1)
    assert run.summary["row_error_px"] < 0.7
    for side, rectified in zip(("left", "right"), run.rectified, strict=True):
        written = read_image(tmp_path / "out" / side / "0.jpg").astype(int)
        # What JPEG at OpenCV's quality of 95 loses.
        assert np.abs(written - rectified).mean() < 3


def test_one_pair_with_too_few_matches_asks_for_several(tmp_path: Path) -> None:
    for side in ("l", "r"):
        write_image(tmp_path / f"{side}.png", np.full((60, 80), 128, np.uint8))
    with pytest.raises(CalibrationError, match=r"l\.png: .*several pairs are needed.*--calib"):
        run_rectify(str(tmp_path / "l.png"), str(tmp_path / "r.png"), load_config())
