"""The experiments' input, and the geometry that Table 1 describes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import CalibrationError, SettingsError, SourceError
from recon.core.geometry.projection import depth_from_disparity
from recon.core.values import DisparityTruth, RectifiedCamera
from recon.evaluation.paper.methods import compare_depth
from recon.evaluation.paper.scenes import (
    EXPERIMENTS,
    camera_of_table_1,
    default_scenes_folder,
    read_experiments,
)
from recon.evaluation.paper.settings import PaperSettings

CAMERA = RectifiedCamera(935.0, 148.0, 138.0, 198.0, 0.16, 347, 277, 64)
"""That of ArtL at quarter size."""


def test_table_1_takes_doffs_for_the_focal_length_and_adds_nothing_to_the_disparity() -> None:
    d = np.array([1.0, 16.0, 58.0])
    assert np.allclose(depth_from_disparity(d, camera_of_table_1(CAMERA)), 50 * 0.16 / d, rtol=1e-6)


def test_doffs_of_zero_is_no_focal_length() -> None:
    camera = RectifiedCamera(935.0, 148.0, 138.0, 148.0, 0.16, 347, 277)
    with pytest.raises(CalibrationError, match="doffs"):
        camera_of_table_1(camera)


def test_true_depths_have_no_error_and_those_of_table_1_a_large_one() -> None:
    values = np.linspace(16, 58, 200, dtype=np.float32).reshape(10, 20)
    truth = DisparityTruth(values, np.isfinite(values))
    right = compare_depth(depth_from_disparity(values, CAMERA), truth, CAMERA)
    wrong = compare_depth(depth_from_disparity(values, camera_of_table_1(CAMERA)), truth, CAMERA)
    assert right is not None
    assert wrong is not None
    assert right.median_error_percent == 0
    assert right.median_ratio == 1
    # Z'/Z = doffs·(d + doffs) / (f·d): 0.22 at d = 16, 0.10 at d = 58.
    assert 0.10 < wrong.median_ratio < 0.22
    assert wrong.pixels == 200


def test_without_a_common_pixel_there_are_no_depth_figures() -> None:
    values = np.full((4, 5), 20, dtype=np.float32)
    truth = DisparityTruth(values, np.isfinite(values))
    assert compare_depth(np.full((4, 5), np.nan, dtype=np.float32), truth, CAMERA) is None


def test_missing_scenes_are_named(tmp_path: Path) -> None:
    (tmp_path / "ArtL").mkdir()
    with pytest.raises(SourceError, match="Jadeplant, Pipes"):
        read_experiments(tmp_path)


def test_the_default_folder_needs_recon_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RECON_DATA", raising=False)
    with pytest.raises(SourceError, match="RECON_DATA"):
        default_scenes_folder()
    monkeypatch.setenv("RECON_DATA", "somewhere")
    assert default_scenes_folder() == Path("somewhere/middlebury/MiddEval3/trainingQ")


@pytest.mark.parametrize("values", [{"patch_px": 4}, {"patches_px": [3, 6]}, {"patches_px": []}])
def test_even_patches_and_none_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(SettingsError, match="patch"):
        PaperSettings.parse(values)


@pytest.mark.real
def test_the_real_scenes_have_the_numbers_that_identify_table_1(recon_data: Path) -> None:
    folder = recon_data / "middlebury" / "MiddEval3" / "trainingQ"
    rows = read_experiments(folder)
    assert [row.number for row in rows] == list(EXPERIMENTS)
    # Ref: doffs, baseline, ndisp as the paper's Table 1 prints them.
    printed = [
        (row.doffs_px, round(1e3 * row.camera.baseline_m, 6), row.camera.ndisp) for row in rows
    ]
    assert printed == [
        (50.0, 160.0, 64),
        (201.044, 380.135, 160),
        (19.331, 236.922, 75),
    ]
    assert [row.camera.focal_px for row in rows] == [935.0, 1823.297, 989.886]
