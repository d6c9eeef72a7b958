"""The hit kernel equals its numpy reference, and describes hits as geometry says."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.street.kernels.surface import (
    _MIN_COSINE,
    MAX_STRETCH,
    MAX_TAPS,
    SurfaceHits,
    SurfaceTable,
    describe_hits,
    fractal_noise,
    value_noise,
)


def describe_hits_reference(table, faces, origin, directions, pixel):
    plane = table.normal[faces]
    along = (directions * plane).sum(axis=1)
    depth = ((table.anchor[faces] - origin) * plane).sum(axis=1) / along
    xyz = origin + depth[:, None] * directions
    local = (xyz - table.anchor[faces])[:, :, None]

    view = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    cosine = (view * plane).sum(axis=1)
    stretch = 1.0 / np.maximum(np.abs(cosine), _MIN_COSINE)
    width = depth * pixel * np.maximum(stretch / MAX_STRETCH, 1.0)
    stretch = np.minimum(stretch, MAX_STRETCH)
    sine = np.maximum(np.sqrt(np.maximum(1.0 - cosine**2, 0.0)), 1e-9)
    smear = (width * np.sqrt(stretch**2 - 1.0) / sine)[:, None] * (view - cosine[:, None] * plane)

    shading = table.shading[faces] + (table.to_shading[faces] @ local)[:, :, 0]
    shading *= (-np.sign(along) / np.linalg.norm(shading, axis=1))[:, None]
    to_uv = table.to_uv[faces]
    across = np.linalg.norm(to_uv, axis=2) * width[:, None]
    return SurfaceHits(
        xyz=xyz,
        normal=shading,
        uv=table.uv[faces] + (to_uv @ local)[:, :, 0],
        width=width,
        smear=smear,
        spread=np.hypot(across, (to_uv @ smear[:, :, None])[:, :, 0]),
    )


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 30), pixel=st.floats(1e-4, 1e-2))
def test_kernel_equals_reference(seed, n, pixel):
    rng = np.random.default_rng(seed)
    normal, shading = rng.normal(size=(2, 8, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    shading += 2 * np.sign(shading)  # longer than what `to_shading` adds
    maps = {"to_uv": rng.normal(size=(8, 2, 3)), "to_shading": 1e-3 * rng.normal(size=(8, 3, 3))}
    anchor, uv = rng.uniform(-20, 20, (8, 3)), rng.normal(size=(8, 2))
    table = SurfaceTable(anchor=anchor, normal=normal, uv=uv, shading=shading, **maps)
    faces = rng.integers(0, 8, n).astype(np.int32)
    rays = np.column_stack([rng.normal(size=(n, 2)), np.ones(n)])
    # Depths are divided by the cosine, smears by the sine: neither is small here.
    cosine = np.abs((rays * normal[faces]).sum(axis=1)) / np.linalg.norm(rays, axis=1)
    well = (cosine > 0.03) & (cosine < 0.999)
    arguments = (table, faces[well], rng.normal(size=3), rays[well], pixel)
    found, expected = describe_hits(*arguments), describe_hits_reference(*arguments)
    for name in SurfaceHits._fields:
        # Some 64 operations on numbers below 1e4, divided twice by 0.03: 64 · 2^-53 · 1e4 · 1e3.
        ours, theirs = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-7, err_msg=name)


def fractal_noise_reference(xyz, smear, width, wavelength, octaves, gain, seed) -> np.ndarray:
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


@settings(max_examples=60)
@given(
    xyz=st.lists(st.tuples(*[st.floats(-500.0, 500.0)] * 3), min_size=1, max_size=4),
    smear=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    width=st.floats(1e-3, 2.0),
    wavelength=st.floats(0.05, 5.0),
    octaves=st.integers(1, 7),
    gain=st.floats(0.3, 1.0),
    seed=st.integers(0, 2**31 - 1),
)
def test_noise_equals_its_reference(xyz, smear, width, wavelength, octaves, gain, seed):
    n = len(xyz)
    footprint = np.tile(np.array(smear), (n, 1)), np.full(n, width), np.full(n, wavelength)
    arguments = (np.array(xyz), *footprint, octaves, gain, seed)
    # Lattice cells of the finest octave are 1e-3 m; 500 m in double precision is exact to 1e-13 m,
    # so the two may differ by 1e-10 of a cell, times a slope below 4, times 7 octaves.
    expected = fractal_noise_reference(*arguments)
    np.testing.assert_allclose(fractal_noise(*arguments), expected, rtol=0, atol=1e-7)


def _plain_noise(n: int, width: float, seed: int = 0) -> np.ndarray:
    xyz = np.random.default_rng(0).uniform(-50.0, 50.0, (n, 3))
    return fractal_noise(xyz, np.zeros_like(xyz), np.full(n, width), np.ones(n), 6, 0.8, seed)


def test_noise_has_mean_zero_a_spread_that_shrinks_with_the_footprint_and_a_pattern_per_seed():
    noise = _plain_noise(3000, 1e-4)
    assert abs(noise.mean()) < 0.02
    assert 0.2 < noise.std() < 0.4
    assert np.abs(noise).max() < 2.0
    spread = [_plain_noise(1000, width).std() for width in (0.01, 0.1, 0.3, 0.6)]
    assert spread == sorted(spread, reverse=True)
    assert not _plain_noise(50, 1.1).any()  # wider than the coarsest blotch
    # 3000 independent pairs correlate by 0.02 (one sigma).
    assert abs(np.corrcoef(noise, _plain_noise(3000, 1e-4, 2_000_000))[0, 1]) < 0.1
