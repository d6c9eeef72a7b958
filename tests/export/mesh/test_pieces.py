"""The surface of a drive is built from adjoining tiles, and removed where cameras saw through."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import MeshingError, OutputError
from recon.core.values import OccupancyVoxels, PointCloud, TriangleMesh
from recon.export.mesh.cut import Plane, nearest_on_edges, open_edges
from recon.export.mesh.pieces import export_mesh
from recon.export.mesh.poisson import MeshSettings
from recon.io.models.mesh import read_mesh
from recon.io.models.ply import write_ply
from recon.map.tiles import Tiles
from recon.run.directory import RunDirectory

STEP_M = 0.1
CONFIG = load_config(None, ["submaps.tile_m=6.4"])
SETTINGS = MeshSettings(tile_m=8.0, trim_density_quantile=0.0)


def street(seed: int = 0) -> PointCloud:
    """A bumpy street from x = -2 to 11.5 m, 6 m wide, with a wall along it; 1 cm of noise."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(-2, 11.5, STEP_M), np.arange(-3, 3, STEP_M), indexing="ij")
    z = 0.1 * np.sin(x) + 0.05 * np.cos(2 * y)
    ground = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    along, up = np.meshgrid(np.arange(-2, 11.5, STEP_M), np.arange(0.3, 2.5, STEP_M), indexing="ij")
    wall = np.stack([along, np.full_like(along, 3.0), up], axis=-1).reshape(-1, 3)
    xyz = np.concatenate([ground, wall]) + rng.normal(0, 0.01, (len(ground) + len(wall), 3))
    normals = np.concatenate(
        [np.tile([0.0, 0.0, 1.0], (len(ground), 1)), np.tile([0.0, -1.0, 0.0], (len(wall), 1))]
    )
    return PointCloud(
        xyz.astype(np.float32),
        rgb=np.where(np.arange(len(xyz))[:, None] < len(ground), 90, 200).repeat(3, 1).astype("u1"),
        normals=normals.astype(np.float32),
        frame="map",
    )


@pytest.fixture
def store() -> Tiles:
    return filled()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[TriangleMesh, list[TriangleMesh]]:
    """The mesh of the street, and its tiles."""
    folder = tmp_path_factory.mktemp("street")
    with pytest.MonkeyPatch.context() as patch:
        overlap_less(patch)
        whole, tiles, warnings = written(filled(), folder / "out", threads=1)
    assert warnings == []
    return whole, tiles


def overlap_less(patch: pytest.MonkeyPatch) -> None:
    """Let tiles overlap in the proportion of the pieces of 8 m, which are small."""
    patch.setattr("recon.export.mesh.pieces.OVERLAP_M", 1.5)


def filled() -> Tiles:
    store = Tiles(CONFIG, np.eye(4))
    cloud = street()
    # As from a drive: in pieces that do not know the tiles.
    for part in np.array_split(np.arange(len(cloud)), 7):
        store.put_cloud(cloud.select(part))
    return store


def written(
    store: Tiles, folder: Path, settings: MeshSettings = SETTINGS, threads: int | None = None
) -> tuple[TriangleMesh, list[TriangleMesh], list[str]]:
    """The whole mesh, that of each tile, and the warnings."""
    with RunDirectory(folder) as directory:
        layer = directory.path("mesh/cloud.ply")
        write_ply(layer, street())
        found = export_mesh(store, settings, directory, layer, threads)
        directory.write_json("run.json", {"files": directory.files()})
    tiles = [read_mesh(path) for path in sorted((folder / "mesh" / "tiles").glob("*.ply"))]
    return read_mesh(folder / "mesh" / "mesh.ply"), tiles, list(found.warnings)


def test_tiles_lie_on_the_surface_and_are_the_whole(
    made: tuple[TriangleMesh, list[TriangleMesh]],
) -> None:
    whole, tiles = made
    assert len(tiles) == 2
    assert sum(len(tile.faces) for tile in tiles) == len(whole.faces)
    np.testing.assert_array_equal(whole.vertices, np.concatenate([t.vertices for t in tiles]))
    # Within what was sampled; beyond it the surface goes on for two spacings, as it likes.
    inside = (np.abs(whole.vertices[:, 1]) < 2.5) & (np.abs(whole.vertices[:, 0] - 5) < 6)
    x, y, z = whole.vertices[inside].T
    # Noise of 1 cm is smoothed; an octree cell of 0.1 m adds little on a bump of 1 m.
    assert np.abs(z - 0.1 * np.sin(x) - 0.05 * np.cos(2 * y)).max() < 0.03
    assert whole.rgb is not None
    assert set(np.unique(whole.rgb)) >= {90, 200}


def test_no_gap_is_left_where_tiles_meet(made: tuple[TriangleMesh, list[TriangleMesh]]) -> None:
    left, right = made[1]
    plane = Plane(0, 4.0)
    borders = [open_edges(mesh, plane) for mesh in (left, right)]
    assert all(len(border) > 60 for border in borders)
    for here, there in (borders, borders[::-1]):
        along = np.linspace(0, 1, 5, dtype=np.float32)[None, :, None]
        points = (here[:, :1] * (1 - along) + here[:, 1:] * along).reshape(-1, 3)
        distance_m = nearest_on_edges(points, there).distance_m
        assert distance_m.max() < 0.1
        assert np.percentile(distance_m, 95) < 1e-4


def test_tiles_made_at_once_are_those_made_one_by_one(
    made: tuple[TriangleMesh, list[TriangleMesh]],
    store: Tiles,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    overlap_less(monkeypatch)
    alone, together = made[0], written(store, tmp_path / "out", threads=3)[0]
    np.testing.assert_array_equal(together.vertices, alone.vertices)
    np.testing.assert_array_equal(together.faces, alone.faces)


def test_a_target_is_that_of_all_tiles(store: Tiles, tmp_path: Path) -> None:
    settings = SETTINGS.model_copy(update={"target_faces": 4000})
    whole, _, _ = written(store, tmp_path / "out", settings)
    assert 3000 < len(whole.faces) < 5000


def test_what_hangs_where_cameras_looked_is_cut_off(store: Tiles, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    ball = rng.normal(0, 1, (3000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    ghost = PointCloud(
        (0.5 * ball + [1.0, 0.0, 1.6]).astype(np.float32),
        rgb=np.full((3000, 3), 255, np.uint8),
        normals=ball.astype(np.float32),
        frame="map",
    )
    store.put_cloud(ghost)
    cells = np.stack(np.meshgrid(*[np.arange(-8, 20)] * 2, np.arange(3, 13), indexing="ij"), -1)
    free = cells.reshape(-1, 3).astype(np.int32)
    store.put_voxels(OccupancyVoxels(free, np.full(len(free), -1, np.float32), 0.2))
    kept = SETTINGS.model_copy(update={"free_space": False})
    assert (written(store, tmp_path / "kept", kept)[0].vertices[:, 2] > 1.0).sum() > 500
    whole = written(store, tmp_path / "cut")[0]
    above = whole.vertices[(whole.vertices[:, 2] > 1.0) & (whole.vertices[:, 1] < 2.5)]
    assert len(above) == 0


def test_tiles_with_too_few_points_are_reported_in_one_line(store: Tiles, tmp_path: Path) -> None:
    stray = np.array([[60, 60, 0], [61, 60, 0], [90, 90, 0]], dtype=np.float32)
    cloud = street().select(np.arange(3))
    store.put_cloud(PointCloud(stray, rgb=cloud.rgb, normals=cloud.normals, frame="map"))
    coarse = SETTINGS.model_copy(update={"max_depth": 5})
    warnings = written(store, tmp_path / "out", coarse)[2]
    assert len(warnings) == 1
    assert warnings[0].startswith("no surface in 2 of 4 tiles, 0.0% of the points (too few points")


def test_a_store_without_a_surface_or_a_folder_is_an_error(store: Tiles, tmp_path: Path) -> None:
    with pytest.raises(MeshingError, match="no part of the map gives a surface"):
        written(Tiles(CONFIG, np.eye(4)), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").write_text("a file")
    with pytest.raises(OutputError):
        written(store, tmp_path / "out")
