"""The calibration files that docs/calibration.md prints in full."""

import re

import numpy as np
import pytest

from recon.io.cameras.calibration import read_calibration, write_recon_calibration
from tests.docs.blocks import ROOT, blocks_of

FILES = [
    block.text for block in blocks_of(ROOT / "docs" / "calibration.md") if block.language == "yaml"
]


def test_a_rig_can_be_typed_rectified_or_without_lens_distortion(tmp_path):
    (tmp_path / "rig.yaml").write_text(FILES[0])
    camera = read_calibration(tmp_path / "rig.yaml", 1280, 720)
    assert (camera.focal_px, camera.baseline_m, camera.doffs_px) == (721.5, 0.12, 0)
    # The same as --focal 721.5 --baseline 0.12, as the page says.
    assert (camera.cx_px, camera.cy_px) == ((1280 - 1) / 2, (720 - 1) / 2)
    text = re.sub(r"^  distortion:.*$", "  distortion: {}", FILES[1], flags=re.MULTILINE)
    (tmp_path / "rig.yaml").write_text(text)
    rig = read_calibration(tmp_path / "rig.yaml", 1280, 720)
    np.testing.assert_array_equal(rig.left.distortion, [])


LENSES = {
    "pinhole": "k1: -0.29, k2: 0.09, p1: 0.0002, p2: -0.0001, k3: -0.01",
    "fisheye": "k1: -0.012, k2: 0.003, k3: -0.0015, k4: 0.0002",
}


@pytest.mark.parametrize("model", LENSES)
def test_the_file_of_each_lens_model_is_what_recon_writes(tmp_path, model):
    assert f"{{{LENSES[model]}}}" in (ROOT / "docs" / "calibration.md").read_text()
    text = FILES[1].replace(LENSES["pinhole"], LENSES[model]).replace("pinhole", model)
    (tmp_path / "rig.yaml").write_text(text)
    rig = read_calibration(tmp_path / "rig.yaml", 1280, 720)
    assert (rig.left.model, len(rig.right.distortion)) == (model, LENSES[model].count(":"))
    write_recon_calibration(tmp_path / "again.yaml", rig)
    assert (tmp_path / "again.yaml").read_text() == text
