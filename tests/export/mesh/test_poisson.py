"""Meshes of sampled shapes lie on them, stay open where there is no data, and face outwards."""

from __future__ import annotations

import os
from functools import cache

import numpy as np
import pytest

from recon.core.errors import MeshingError
from recon.core.values import PointCloud, TriangleMesh
from recon.export.mesh.poisson import MeshSettings, _fitting_depth, reconstruct_mesh


def sphere(n: int = 3000, radius_m: float = 1.0) -> PointCloud:
    """Points evenly spread on a sphere about (3, 0, 5) (Fibonacci lattice)."""
    k = np.arange(n) + 0.5
    z, angle = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z**2)
    normals = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    return PointCloud(
        xyz=(radius_m * normals + [3, 0, 5]).astype(np.float32),
        rgb=np.where(normals[:, :1] > 0, [[200, 0, 0]], [[0, 0, 200]]).astype(np.uint8),
        normals=normals.astype(np.float32),
    )


def radii(mesh: TriangleMesh) -> np.ndarray:
    return np.linalg.norm(mesh.vertices - [3, 0, 5], axis=1)


def boundary_edges(mesh: TriangleMesh) -> int:
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return int((np.unique(edges, axis=0, return_counts=True)[1] == 1).sum())


WHOLE = MeshSettings(depth=5, trim_density_quantile=0)


@cache
def whole_sphere() -> TriangleMesh:
    return reconstruct_mesh(sphere(), WHOLE)


def test_the_mesh_of_a_sphere_lies_on_it_is_closed_faces_out_and_has_its_colours() -> None:
    mesh = whole_sphere()
    # Cells of 2.2 m / 2^5 = 69 mm; the surface is placed far better than a cell.
    assert np.abs(radii(mesh) - 1).max() < 0.005
    assert boundary_edges(mesh) == 0
    outwards = mesh.vertices - np.float32([3, 0, 5])
    assert mesh.normals is not None
    assert (np.einsum("ij,ij->i", mesh.normals, outwards) > 0.99).all()
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
    volume = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - [3, 0, 5]).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.01)
    assert mesh.rgb is not None
    assert (mesh.rgb[outwards[:, 0] > 0.05] == [200, 0, 0]).all()
    assert (mesh.rgb[outwards[:, 0] < -0.05] == [0, 0, 200]).all()


def test_a_hole_in_the_data_stays_a_hole() -> None:
    cloud = sphere()
    cap = cloud.xyz[:, 2] > 5.6
    mesh = reconstruct_mesh(cloud.select(~cap), MeshSettings(depth=5))
    # Point spacing is about 10 cm to the sixth neighbour: two of those beyond the rim at most.
    assert mesh.vertices[:, 2].max() < 5.6 + 0.22
    assert boundary_edges(mesh) > 30
    balloon = reconstruct_mesh(
        cloud.select(~cap), WHOLE.model_copy(update={"max_distance_spacings": None})
    )
    assert balloon.vertices[:, 2].max() > 5.6 + 0.22


def test_small_pieces_are_dropped() -> None:
    cloud, far = sphere(), sphere(300, radius_m=0.05)
    both = PointCloud(
        xyz=np.concatenate([cloud.xyz, far.xyz + np.float32([3, 0, 0])]),
        normals=np.concatenate([cloud.normals, far.normals]),
    )
    mesh = reconstruct_mesh(both, MeshSettings(depth=6, min_component_faces=1000))
    assert mesh.vertices[:, 0].max() < 4.2


def test_decimation_reaches_its_target_and_stays_on_the_sphere() -> None:
    mesh = reconstruct_mesh(sphere(), WHOLE.model_copy(update={"target_faces": 1000}))
    assert 900 <= len(mesh.faces) <= 1000
    assert np.abs(radii(mesh) - 1).max() < 0.02


def test_the_same_cloud_gives_the_same_mesh_and_nothing_else_is_touched(
    capfd: pytest.CaptureFixture[str],
) -> None:
    before = os.getcwd()  # noqa: PTH109 - the very thing that MeshLab can break
    first, second = (reconstruct_mesh(sphere(1000), MeshSettings(depth=4)) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.faces, second.faces)
    assert os.getcwd() == before  # noqa: PTH109
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("viewpoint_m", [None, (3.0, 0.0, 5.0)])
def test_a_cloud_without_normals_gets_them(
    viewpoint_m: tuple[float, float, float] | None,
) -> None:
    cloud = PointCloud(sphere(1000).xyz)
    mesh = reconstruct_mesh(cloud, MeshSettings(depth=4, trim_density_quantile=0), viewpoint_m)
    assert np.abs(radii(mesh) - 1).max() < 0.02
    assert mesh.normals is not None
    along = np.einsum("ij,ij->i", mesh.normals, mesh.vertices - np.float32([3, 0, 5]))
    assert (np.abs(along) > 0.9).all()
    assert len(set(np.sign(along))) == 1
    if viewpoint_m is not None:
        assert (along < 0).all()  # seen from inside


def test_points_and_normals_that_are_not_finite_are_left_out() -> None:
    cloud = sphere()
    xyz, normals = cloud.xyz.copy(), cloud.normals.copy()
    xyz[::50] = np.nan
    normals[::70] = 0
    normals[1::90] = np.nan
    mesh = reconstruct_mesh(PointCloud(xyz, normals=normals), MeshSettings(depth=5))
    assert np.abs(radii(mesh) - 1).max() < 0.02


@pytest.mark.parametrize(
    ("xyz", "complaint"),
    [
        (np.zeros((0, 3)), "too few points"),
        (np.eye(3), "too few points"),
        (np.full((500, 3), np.nan), "too few points"),
        (np.full((500, 3), 2.5), "one place or on one line"),
        (np.outer(np.linspace(0, 1, 500), [1.0, 2.0, 3.0]), "one place or on one line"),
        (np.vstack([sphere(500).xyz, [1e6, 0, 5]]), "a point lies far from all others"),
        (np.vstack([sphere(500).xyz, [0, 1e30, 5]]), "a point lies far from all others"),
        (np.random.default_rng(0).normal(size=(500, 3)) + 4e6, "subtract an offset"),
    ],
)
def test_clouds_without_a_surface_are_refused(xyz: np.ndarray, complaint: str) -> None:
    with pytest.raises(MeshingError, match=complaint):
        reconstruct_mesh(PointCloud(xyz.astype(np.float32)), MeshSettings())


def test_the_depth_follows_the_spacing_of_the_points() -> None:
    coarse, fine = sphere(1000), sphere(16000)  # spacings differ by four: two levels
    chosen = [_fitting_depth(cloud.xyz, MeshSettings()) for cloud in (coarse, fine)]
    assert chosen[1] - chosen[0] == 2
    assert _fitting_depth(fine.xyz, MeshSettings(max_depth=4)) == 4
    assert _fitting_depth((100 * fine.xyz).astype(np.float32), MeshSettings()) == chosen[1]


def test_points_of_one_plane_give_that_plane() -> None:
    xyz = np.random.default_rng(0).uniform(0, 1, (3000, 3)).astype(np.float32)
    xyz[:, 2] = 2
    mesh = reconstruct_mesh(PointCloud(xyz), MeshSettings())
    assert len(mesh.faces) > 1000
    # A tenth of the spacing of the points, which is 1 / sqrt(3000).
    assert np.abs(mesh.vertices[:, 2] - 2).max() < 0.002
