"""The calibration files that docs/calibration.md prints in full."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.core.values import RectifiedCamera, StereoCalibration
from recon.io.cameras.calibration import read_calibration
from recon.io.cameras.recon_yaml import write_recon_calibration
from tests.docs.blocks import ROOT, blocks_of

FILES = [
    block.text for block in blocks_of(ROOT / "docs" / "calibration.md") if block.language == "yaml"
]


def test_a_rectified_rig_can_be_typed(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(FILES[0])
    camera = read_calibration(tmp_path / "rig.yaml", 1280, 720)
    assert isinstance(camera, RectifiedCamera)
    assert (camera.focal_px, camera.baseline_m, camera.doffs_px) == (721.5, 0.12, 0)
    # The same as --focal 721.5 --baseline 0.12, as the page says.
    assert (camera.cx_px, camera.cy_px) == ((1280 - 1) / 2, (720 - 1) / 2)


@pytest.mark.parametrize(
    ("text", "model", "coefficients"),
    list(zip(FILES[1:], ("pinhole", "pinhole", "fisheye"), (5, 8, 4), strict=True)),
)
def test_the_file_of_each_lens_model_is_what_recon_writes(
    tmp_path: Path, text: str, model: str, coefficients: int
) -> None:
    (tmp_path / "rig.yaml").write_text(text)
    rig = read_calibration(tmp_path / "rig.yaml", 1280, 720)
    assert isinstance(rig, StereoCalibration)
    assert (rig.left.model, len(rig.right.distortion)) == (model, coefficients)
    write_recon_calibration(tmp_path / "again.yaml", rig)
    assert (tmp_path / "again.yaml").read_text() == text


def test_without_lens_distortion_the_coefficients_may_be_left_out(tmp_path: Path) -> None:
    lines = [
        "  distortion: {}" if line.startswith("  distortion:") else line
        for line in FILES[1].splitlines()
    ]
    (tmp_path / "rig.yaml").write_text("\n".join(lines))
    rig = read_calibration(tmp_path / "rig.yaml", 1280, 720)
    assert isinstance(rig, StereoCalibration)
    np.testing.assert_array_equal(rig.left.distortion, [])
