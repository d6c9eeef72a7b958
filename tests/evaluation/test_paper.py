"""The geometry that Table 1 describes, and block matching as printed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from recon.core.errors import CalibrationError, MatchingError
from recon.core.values import DisparityTruth, Reason, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Float32, UInt8
from recon.core.values.camera import depth_from_disparity
from recon.evaluation import paper
from tests.scenery.planes import fronto_parallel_pair

CAMERA = RectifiedCamera(935.0, 148.0, 138.0, 198.0, 0.16, 347, 277, 64)
"""That of ArtL at quarter size."""


def camera_for(width_px: int, height_px: int, ndisp: int | None = None) -> RectifiedCamera:
    middle = (width_px / 2, height_px / 2, width_px / 2)
    return RectifiedCamera(60.0, *middle, 0.5, width_px, height_px, ndisp)


def test_true_depths_have_no_error_and_those_of_table_1_a_large_one():
    values = np.linspace(16, 58, 200, dtype=np.float32).reshape(10, 20)
    truth = DisparityTruth(values, np.isfinite(values))
    believed_m = depth_from_disparity(values, paper.camera_of_table_1(CAMERA))
    assert np.allclose(believed_m, 50 * 0.16 / values, rtol=1e-6)
    right = paper.compare_depth(depth_from_disparity(values, CAMERA), truth, CAMERA).to_json()
    wrong = paper.compare_depth(believed_m, truth, CAMERA).to_json()
    assert (right["median_error_percent"], right["median_ratio"]) == (0, 1)
    # Z'/Z = doffs·(d + doffs) / (f·d): 0.22 at d = 16, 0.10 at d = 58.
    assert 0.10 < wrong["median_ratio"] < 0.22
    assert wrong["pixels"] == 200
    assert paper.compare_depth(np.full((10, 20), np.nan, np.float32), truth, CAMERA) is None
    with pytest.raises(CalibrationError, match="doffs"):
        paper.camera_of_table_1(camera_for(347, 277))


@pytest.mark.real
def test_the_real_scenes_have_the_numbers_that_identify_table_1(recon_data):
    rows = [
        *map(
            paper.table_1_row, paper.read_experiments(recon_data / "middlebury/MiddEval3/trainingQ")
        )
    ]
    assert {row["experiment"]: row["scene"] for row in rows} == paper.EXPERIMENTS
    # Ref: doffs, baseline, ndisp as the paper's Table 1 prints them.
    printed = [(50.0, 160.0, 64), (201.044, 380.135, 160), (19.331, 236.922, 75)]
    assert [tuple(row["printed"].values()) for row in rows] == printed
    assert [row["corrected"]["focal_px"] for row in rows] == [935.0, 1823.297, 989.886]


def test_only_absolute_differences_find_a_wall_and_only_whole_patches_have_a_value():
    # 60 px · 0.5 m / 5 m = 6 px exactly.
    scene = fronto_parallel_pair(camera_for(64, 40, 16), 5.0)
    found = paper.PrintedMatcher(7, signed=False).match(scene.pair)
    seen = found.valid.copy()
    seen[:, : 6 + 3] = False  # there the right image does not show the patch
    assert np.mean(found.values[seen] == 6) > 0.99
    signed = paper.PrintedMatcher(7, signed=True).match(scene.pair)
    assert np.mean(signed.values[:, 9:-3] == 6) < 0.3
    left = np.random.default_rng(0).integers(0, 256, (20, 30), dtype=np.uint8)
    pair = RectifiedPair(left, left, camera_for(30, 20))
    found = paper.PrintedMatcher(5, signed=True).match(pair)
    expected = np.zeros(left.shape, dtype=bool)
    expected[2:-2, 2:-2] = True
    assert np.array_equal(found.valid, expected)
    assert np.all(found.reason[~expected] == Reason.BORDER)
    # A value rounded to whole pixels is off by up to half a pixel, each amount as likely.
    sigma_px = np.std(np.linspace(-0.5, 0.5, 999))
    np.testing.assert_allclose(found.sigma_px[expected], sigma_px, rtol=0.01)
    with pytest.raises(MatchingError, match="at most 20 px"):
        paper.PrintedMatcher(21, signed=True).match(pair)


@settings(max_examples=40)
@given(
    data=st.data(),
    shape=st.tuples(st.integers(3, 8), st.integers(3, 14)),
    patch_px=st.sampled_from([1, 3]),
    signed=st.booleans(),
)
def test_it_equals_the_sums_written_out(data, shape, patch_px, signed):
    left, right = (data.draw(hnp.arrays(np.uint8, shape)) for _ in range(2))
    pair = RectifiedPair(left, right, camera_for(shape[1], shape[0], 6))
    found = paper.PrintedMatcher(patch_px, signed).match(pair).values
    assert np.array_equal(found, written_out(left, right, patch_px, signed), equal_nan=True)


def written_out(left: UInt8, right: UInt8, patch_px: int, signed: bool) -> Float32:
    """The same in loops: float32 (H, W), NaN where no patch fits."""
    r = patch_px // 2
    height, width = left.shape
    values = np.full(left.shape, np.nan, dtype=np.float32)
    for y in range(r, height - r):
        for x in range(r, width - r):
            patch = left[y - r : y + r + 1, x - r : x + r + 1].astype(int)
            sums = []
            for d in range(min(6, x - r + 1)):
                there = right[y - r : y + r + 1, x - d - r : x - d + r + 1].astype(int)
                sums.append((patch - there if signed else np.abs(patch - there)).sum())
            values[y, x] = int(np.argmin(sums))
    return values
