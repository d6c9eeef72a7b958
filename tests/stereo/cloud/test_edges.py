"""Flying edges: points between two surfaces are removed, points on a surface stay."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import recon
from recon.core.values import Disparity, Reason, RectifiedCamera, RectifiedPair
from recon.stereo.cloud.back_project import remove_flying_edges


def as_disparity(values: np.ndarray) -> Disparity:
    values = values.astype(np.float32)
    known = np.isfinite(values)
    return Disparity(
        values=values,
        confidence=known.astype(np.float32),
        sigma_px=np.where(known, 0.5, np.nan).astype(np.float32),
        reason=np.where(known, Reason.VALID, Reason.AMBIGUOUS).astype(np.uint8),
    )


def smeared_step(width: int) -> np.ndarray:
    """A foreground of 40 px before a background of 10 px, with a linear ramp between them."""
    row = np.full(60, 10.0)
    row[30:] = 40.0
    row[30 : 30 + width] = np.linspace(10, 40, width + 2)[1:-1]
    return np.tile(row, (40, 1))


@pytest.mark.parametrize("width", [1, 2, 3])
def test_a_step_loses_exactly_its_mixed_pixels(width: int) -> None:
    result = remove_flying_edges(as_disparity(smeared_step(width)))
    mixed = np.zeros((40, 60), dtype=bool)
    mixed[:, 30 : 30 + width] = True
    np.testing.assert_array_equal(result.reason == Reason.EDGE, mixed)


def test_a_clean_step_loses_nothing() -> None:
    result = remove_flying_edges(as_disparity(smeared_step(0)))
    assert result.valid.all()


def test_a_mixed_column_beside_an_occlusion_goes_too() -> None:
    values = smeared_step(1)
    values[:, 20:30] = np.nan
    result = remove_flying_edges(as_disparity(values))
    assert (result.reason[:, 30] == Reason.EDGE).all()
    assert result.valid[:, 32:].all()
    assert (result.reason[:, 20:30] == Reason.AMBIGUOUS).all()


@given(across=st.floats(-0.7, 0.7), down=st.floats(-0.7, 0.7), noise_seed=st.integers(0, 2**16))
def test_every_slant_below_the_gradient_limit_survives(
    across: float, down: float, noise_seed: int
) -> None:
    # 0.7 along each axis is a gradient of 1 at most; noise of ±0.25 differs by 0.5 at most.
    v, u = np.mgrid[:24, :30]
    noise = np.random.default_rng(noise_seed).uniform(-0.25, 0.25, u.shape)
    result = remove_flying_edges(as_disparity(60 + across * u + down * v + noise))
    assert result.valid.all()


def test_a_pole_two_pixels_wide_survives_and_a_lone_pixel_does_not() -> None:
    values = np.full((30, 40), 10.0)
    values[:, 20:22] = 50.0
    values[15, 8] = 30.0
    result = remove_flying_edges(as_disparity(values))
    expected = np.zeros(values.shape, dtype=bool)
    expected[15, 8] = True
    np.testing.assert_array_equal(result.reason == Reason.EDGE, expected)


def test_dropped_pixels_have_no_value_no_confidence_and_no_sigma() -> None:
    result = remove_flying_edges(as_disparity(smeared_step(2)))
    gone = result.reason == Reason.EDGE
    assert np.isnan(result.values[gone]).all()
    assert np.isnan(result.sigma_px[gone]).all()
    assert (result.confidence[gone] == 0).all()


class Smeared:
    """A matcher that finds a smeared step in every pair."""

    def match(self, pair: RectifiedPair) -> Disparity:
        assert pair.left.shape == (40, 60)
        return Disparity.from_values(smeared_step(2))


@pytest.mark.parametrize("removed", [True, False])
def test_it_can_be_turned_off(removed: bool) -> None:
    image = np.random.default_rng(0).integers(0, 256, (40, 60), dtype=np.uint8)
    camera = RectifiedCamera(100.0, 30.0, 20.0, 30.0, 0.1, 60, 40)
    config = recon.load_config(overrides=[f"cloud.remove_flying_edges={removed}"])
    found = recon.reconstruct(image, image, camera, config, matcher=Smeared()).disparity
    assert (Reason.EDGE in found.reason) == removed


@pytest.mark.parametrize("shape", [(3, 3), (3, 200), (200, 4)])
def test_images_as_small_as_the_window_pass(shape: tuple[int, int]) -> None:
    assert remove_flying_edges(as_disparity(np.full(shape, 5.0))).valid.all()


def test_a_map_without_any_disparity_passes() -> None:
    result = remove_flying_edges(as_disparity(np.full((10, 12), np.nan)))
    assert (result.reason == Reason.AMBIGUOUS).all()
