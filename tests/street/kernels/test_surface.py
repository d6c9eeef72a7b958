"""The hit kernel equals its numpy reference, and describes hits as geometry says."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.street.kernels.surface import (
    _MIN_COSINE,
    MAX_STRETCH,
    SurfaceHits,
    SurfaceTable,
    describe_hits,
)


def describe_hits_reference(
    table: SurfaceTable, faces: np.ndarray, origin: np.ndarray, directions: np.ndarray, pixel: float
) -> SurfaceHits:
    """Return what `describe_hits` does, in plain numpy and all points at once."""
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


def _random_table(rng: np.random.Generator, n: int) -> SurfaceTable:
    normal = rng.normal(size=(n, 3))
    return SurfaceTable(
        anchor=rng.uniform(-20, 20, (n, 3)),
        normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        to_uv=rng.normal(size=(n, 2, 3)),
        uv=rng.normal(size=(n, 2)),
        to_shading=0.01 * rng.normal(size=(n, 3, 3)),
        shading=rng.normal(size=(n, 3)),
    )


def _wall(z: float) -> SurfaceTable:
    """The plane at depth z, with u along x and v along y."""
    to_uv = np.array([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    normal = np.array([[0.0, 0.0, 1.0]])
    anchor = np.array([[0.0, 0.0, z]])
    return SurfaceTable(anchor, normal, to_uv, np.zeros((1, 2)), np.zeros((1, 3, 3)), normal)


def _rounding(table: SurfaceTable, faces, origin, rays, xyz) -> SurfaceHits:
    """How far two ways to compute the hits may differ, hit by hit.

    A depth is (anchor - origin)·normal over ray·normal: 12 operations on products of the size of
    anchor and origin, divided by the cosine once for the depth and once for the rounding of the
    cosine itself. A smear is divided by the sine in the same way. The point, and what is computed
    from it, take at most 20 more. Each way may err.
    """
    anchor, normal = table.anchor[faces], table.normal[faces]
    view = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    cosine = np.abs((view * normal).sum(axis=1))
    sine = np.linalg.norm(view - (view * normal).sum(axis=1, keepdims=True) * normal, axis=1)
    reach = 1 + np.linalg.norm(anchor, axis=1) + np.linalg.norm(origin)
    place = 2 * 32 * 2.0**-53 * reach / np.minimum(cosine, sine) ** 2
    shading = table.shading[faces] + np.einsum("nij,nj->ni", table.to_shading[faces], xyz - anchor)
    terms = np.abs(table.shading[faces]).max(axis=1, initial=0.0)
    terms = 1 + terms + np.abs(table.to_shading[faces]).sum(axis=(1, 2))
    by_uv = place * (1 + np.abs(table.uv[faces]).sum(axis=1))
    by_uv *= 1 + np.abs(table.to_uv[faces]).sum(axis=(1, 2))
    return SurfaceHits(
        xyz=place[:, None],
        normal=(place * terms / np.linalg.norm(shading, axis=1))[:, None],
        uv=by_uv[:, None],
        width=place,
        smear=place[:, None],
        spread=by_uv[:, None],
    )


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 30), pixel=st.floats(1e-4, 1e-2))
def test_kernel_equals_reference(seed, n, pixel):
    rng = np.random.default_rng(seed)
    table = _random_table(rng, 8)
    faces = rng.integers(0, 8, n).astype(np.int32)
    rays = np.column_stack([rng.normal(size=(n, 2)), np.ones(n)])
    origin = rng.normal(size=3)
    found = describe_hits(table, faces, origin, rays, pixel)
    expected = describe_hits_reference(table, faces, origin, rays, pixel)
    bounds = _rounding(table, faces, origin, rays, expected.xyz)
    for name in SurfaceHits._fields:
        difference = np.abs(getattr(found, name) - getattr(expected, name))
        assert (difference <= getattr(bounds, name)).all(), name


def test_a_wall_seen_straight_on_has_a_square_footprint():
    hits = describe_hits(
        _wall(8.0), np.zeros(1, np.int32), np.zeros(3), np.array([[0.0, 0.0, 1.0]]), 1 / 400
    )
    assert np.allclose(hits.xyz, [[0.0, 0.0, 8.0]])
    assert np.allclose(hits.width, 8.0 / 400)
    assert np.allclose(hits.smear, 0.0)
    assert np.allclose(hits.spread, 8.0 / 400)


def test_the_normal_faces_the_viewer_from_both_sides():
    rays = np.array([[0.1, 0.0, 1.0]])
    front = describe_hits(_wall(5.0), np.zeros(1, np.int32), np.zeros(3), rays, 0.01)
    behind = describe_hits(_wall(5.0), np.zeros(1, np.int32), np.array([0, 0, 9.0]), -rays, 0.01)
    assert np.allclose(front.normal, [[0, 0, -1]])
    assert np.allclose(behind.normal, [[0, 0, 1]])


def test_a_slanted_view_smears_along_the_surface_by_the_inverse_cosine():
    # 60° from the normal: the footprint is twice as long as it is wide.
    rays = np.array([[np.sqrt(3.0), 0.0, 1.0]])
    hits = describe_hits(_wall(4.0), np.zeros(1, np.int32), np.zeros(3), rays, 0.01)
    assert np.allclose(np.hypot(hits.width, np.linalg.norm(hits.smear)), 2.0 * hits.width)
    assert np.allclose(hits.smear[0, 1:], 0.0)


def test_a_grazing_view_is_widened_beyond_the_greatest_stretch():
    rays = np.array([[1e5, 0.0, 1.0]])
    hits = describe_hits(_wall(1.0), np.zeros(1, np.int32), np.zeros(3), rays, 0.001)
    ratio = np.linalg.norm(hits.smear) / hits.width[0]
    assert MAX_STRETCH - 1.0 < ratio <= MAX_STRETCH
    assert hits.width[0] > 0.001
