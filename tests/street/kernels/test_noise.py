"""The noise kernel equals its reference, and is band-limited by the pixel's footprint."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.street.kernels.surface import MAX_TAPS, fractal_noise, lattice_values, value_noise

coordinate = st.floats(-500.0, 500.0, allow_nan=False)


def fractal_noise_reference(
    xyz: np.ndarray,
    smear: np.ndarray,
    width: np.ndarray,
    wavelength: np.ndarray,
    octaves: int,
    gain: float,
    seed: int,
) -> np.ndarray:
    """Return what `fractal_noise` does, in plain numpy and one point at a time."""
    turn = np.array([[2.0, 3.0, 6.0], [6.0, 2.0, -3.0], [3.0, -6.0, 2.0]]) / 7.0
    amplitudes = gain ** np.arange(octaves)
    out = np.empty(len(width))
    for i in range(len(width)):
        length = float(np.linalg.norm(smear[i]))
        taps = int(np.clip(np.ceil(length / width[i]), 1, MAX_TAPS))
        blur = max(width[i], length / taps)
        along = (np.arange(taps) + 0.5) / taps - 0.5
        points = xyz[i] + along[:, None] * smear[i]
        total = 0.0
        for octave, amplitude in enumerate(amplitudes):
            points = points @ turn.T
            spacing = wavelength[i] * 0.5**octave
            fade = np.clip(spacing / blur - 1.0, 0.0, 1.0)
            total += amplitude * fade * value_noise(points / spacing, seed + octave).mean()
        out[i] = total / np.sqrt((amplitudes**2).sum())
    return out


def _points(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-50.0, 50.0, (n, 3))


@settings(max_examples=60)
@given(
    xyz=st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=4),
    smear=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    width=st.floats(1e-3, 2.0),
    wavelength=st.floats(0.05, 5.0),
    octaves=st.integers(1, 7),
    gain=st.floats(0.3, 1.0),
    seed=st.integers(0, 2**31 - 1),
)
def test_kernel_equals_reference(xyz, smear, width, wavelength, octaves, gain, seed):
    points = np.array(xyz)
    n = len(points)
    arguments = (
        points,
        np.tile(np.array(smear), (n, 1)),
        np.full(n, width),
        np.full(n, wavelength),
        octaves,
        gain,
        seed,
    )
    # Lattice cells of the finest octave are 1e-3 m; 500 m in double precision is exact to 1e-13 m,
    # so the two may differ by 1e-10 of a cell, times a slope below 4, times 7 octaves.
    np.testing.assert_allclose(
        fractal_noise(*arguments), fractal_noise_reference(*arguments), rtol=0, atol=1e-7
    )


def test_noise_has_mean_zero_and_moderate_spread():
    xyz = _points(3000)
    noise = fractal_noise(xyz, np.zeros_like(xyz), np.full(3000, 1e-4), np.ones(3000), 6, 0.8, 3)
    assert abs(noise.mean()) < 0.02
    assert 0.2 < noise.std() < 0.4
    assert np.abs(noise).max() < 2.0


def test_pixels_wider_than_the_coarsest_blotch_see_no_noise():
    xyz = _points(50)
    noise = fractal_noise(xyz, np.zeros_like(xyz), np.full(50, 1.0), np.full(50, 0.9), 5, 0.8, 0)
    assert np.array_equal(noise, np.zeros(50))


def test_blur_grows_with_the_footprint():
    xyz = _points(1000)
    spread = [
        fractal_noise(xyz, np.zeros_like(xyz), np.full(1000, w), np.ones(1000), 6, 0.8, 0).std()
        for w in (0.01, 0.1, 0.3, 0.6)
    ]
    assert spread == sorted(spread, reverse=True)


def test_a_smear_averages_along_its_direction():
    xyz = _points(3)
    smear = np.tile([0.4, 0.0, 0.0], (3, 1))
    width = np.full(3, 0.4 / MAX_TAPS)
    smeared = fractal_noise(xyz, smear, width, np.ones(3), 4, 0.8, 0)
    at = (np.arange(MAX_TAPS) + 0.5) / MAX_TAPS - 0.5
    taps = [
        fractal_noise(xyz + a * smear, np.zeros((3, 3)), width, np.ones(3), 4, 0.8, 0) for a in at
    ]
    np.testing.assert_allclose(smeared, np.mean(taps, axis=0), atol=1e-12)


def test_another_seed_is_another_pattern():
    xyz = _points(2000)
    one, two = (
        fractal_noise(xyz, np.zeros_like(xyz), np.full(2000, 1e-3), np.ones(2000), 4, 0.8, seed)
        for seed in (1, 2_000_000)
    )
    # 2000 independent pairs correlate by 0.02 (one sigma).
    assert abs(np.corrcoef(one, two)[0, 1]) < 0.1


def test_read_only_points_are_taken():
    xyz = _points(4)
    xyz.flags.writeable = False
    assert fractal_noise(xyz, np.zeros((4, 3)), np.ones(4), np.ones(4), 2, 0.5, 0).shape == (4,)


def test_noise_takes_the_lattice_values_at_lattice_points():
    corners = np.array([[0.0, 0.0, 0.0], [3.0, -7.0, 2.0], [-1.0, -1.0, -1.0]])
    ix, iy, iz = corners.astype(int).T
    np.testing.assert_array_equal(value_noise(corners, 9), lattice_values(ix, iy, iz, 9))


def test_lattice_values_fill_their_range_evenly():
    index = np.arange(-5000, 5000)
    values = lattice_values(index, index * 0, index * 0 + 4, 1)
    assert values.min() >= -1.0
    assert values.max() < 1.0
    # 10 bins of 1000 ± 30 (one sigma).
    assert (np.abs(np.histogram(values, 10, (-1, 1))[0] - 1000) < 150).all()
