"""The mesh of a drive, built tile by tile and cut at tile borders to bound memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import MeshingError
from recon.core.geometry.transform import transform_cloud
from recon.core.values import TriangleMesh
from recon.core.values.arrays import Float32
from recon.export.mesh import (
    MeshSettings,
    Plane,
    close_seam,
    cut_mesh,
    looked_through,
    open_edges,
    reconstruct_mesh,
)
from recon.export.mesh.tile_store import TileStore
from recon.io.models.mesh import join_meshes, read_mesh, write_mesh
from recon.io.models.mlp import write_mlp
from recon.map.drive_map import Tile
from recon.map.sequence import MappedSequence
from recon.run.directory import RunDirectory
from recon.run.lookahead import side_by_side
from recon.run.machine import available_cores

SAMPLE_FACES: Final = 2_000_000
"""Largest number of triangles of a mesh that is loaded whole for images."""
_MOST_AT_ONCE: Final = 4
_SIDES: Final = ((0, 0), (0, 1), (1, 0), (1, 1))
"""The four sides of a tile: (axis, 1 for the far side)."""


_OVERLAP_M: Final = 3.0
"""Margin around a tile whose points its surface is fitted to as well."""

_SEAM_M: Final = 0.15
"""Widest gap that is closed where two tiles meet."""


@dataclass(frozen=True)
class MeshTile:
    """A tile whose mesh is written.

    Attributes:
        tile: Its index.
        path: Its PLY file.
        vertices: Number of vertices.
        faces: Number of faces.
    """

    tile: Tile
    path: Path
    vertices: int
    faces: int


@dataclass(frozen=True, eq=False)
class WrittenMesh:
    """A mesh whose files are written.

    Attributes:
        tiles: Its tiles.
        warnings: Parts that could not be meshed.
    """

    tiles: tuple[MeshTile, ...]
    warnings: tuple[str, ...]

    @property
    def faces(self) -> int:
        """Number of triangles."""
        return sum(tile.faces for tile in self.tiles)

    @property
    def vertices(self) -> int:
        """Number of vertices."""
        return sum(tile.vertices for tile in self.tiles)

    def to_show(self, directory: RunDirectory) -> TriangleMesh | None:
        """Return the mesh for images; None if it is too large for memory."""
        return read_mesh(directory.path("mesh/mesh.ply")) if self.faces <= SAMPLE_FACES else None


def store_map(mapped: MappedSequence, settings: MeshSettings, folder: Path) -> TileStore:
    """Store the fused cloud and the voxels of a drive tile by tile.

    Raises:
        OutputError: The folder cannot be written.
    """
    store = TileStore(folder, settings.tile_m)
    for _, cloud in mapped.map.cloud_tiles():
        store.put_cloud(transform_cloud(cloud, mapped.T_map_world, frame="map"))
    if settings.free_space:
        for tile, voxels in mapped.map.occupancy_tiles():
            store.put_voxels(mapped.map.inner(tile, voxels))
    return store


def write_drive_mesh(
    store: TileStore,
    settings: MeshSettings,
    directory: RunDirectory,
    cloud: Path,
    threads: int | None = None,
) -> WrittenMesh:
    """Write ``mesh/mesh.ply``, its tiles if there are several, and ``mesh/mesh.mlp``.

    Args:
        store: Points, and voxels if free space is known.
        settings: Settings of the mesh; ``target_faces`` is the total over all tiles.
        directory: The folder of the run.
        cloud: A PLY file in it, for the MeshLab project.
        threads: Tiles reconstructed at a time, each in its own process; None = one per core, at
            most four, since each needs memory. Does not change results.

    Raises:
        MeshingError: No tile has a surface.
        OutputError: A file cannot be written.
    """
    at_once = threads or min(available_cores(), _MOST_AT_ONCE)
    found = _Mesher(store, settings, directory, at_once).run()
    if not found.tiles:
        raise MeshingError(
            "no part of the map gives a surface", got="; ".join(found.warnings) or "no point"
        )
    whole = directory.path("mesh/mesh.ply")
    join_meshes(whole, [(tile.path, tile.vertices, tile.faces) for tile in found.tiles])
    layers = {tile.path.stem: tile.path for tile in found.tiles}
    if len(found.tiles) == 1:
        found.tiles[0].path.unlink()
        layers = {"mesh": whole}
    write_mlp(directory.path("mesh/mesh.mlp"), {**layers, "cloud": cloud}, "map")
    return found


@dataclass(eq=False)
class _Mesher:
    """Reconstructs tiles in parallel; each tile closes its seams to earlier ones, in order."""

    store: TileStore
    settings: MeshSettings
    directory: RunDirectory
    threads: int
    borders: dict[tuple[Tile, Plane], Float32] = field(default_factory=dict)

    def run(self) -> WrittenMesh:
        tiles: list[MeshTile] = []
        failed: dict[Tile, MeshingError] = {}
        surfaces = side_by_side(self._surface, self.store.tiles, threads=self.threads)
        for tile, surface in zip(self.store.tiles, surfaces, strict=True):
            if isinstance(surface, MeshingError):
                failed[tile] = surface
                continue
            mesh = self._joined(tile, surface)
            if len(mesh.faces):
                path = self.directory.path(f"mesh/tiles/tile_{tile[0]}_{tile[1]}.ply")
                write_mesh(path, mesh)
                tiles.append(MeshTile(tile, path, len(mesh.vertices), len(mesh.faces)))
        return WrittenMesh(tuple(tiles), self._warnings(failed))

    def _warnings(self, failed: dict[Tile, MeshingError]) -> tuple[str, ...]:
        """One line about the tiles without a surface, naming the one with the most points."""
        if not failed:
            return ()
        worst = max(failed, key=self.store.points)
        share = sum(map(self.store.points, failed)) / self.store.total
        tiles = f"{len(failed)} of {len(self.store.tiles)} tiles"
        return (f"no surface in {tiles}, {share:.1%} of the points ({failed[worst]})",)

    def _surface(self, tile: Tile) -> TriangleMesh | MeshingError:
        """The surface of a tile, or the error why there is none, handled when its turn comes."""
        try:
            return self._cut(tile)
        except MeshingError as error:
            return error

    def _cut(self, tile: Tile) -> TriangleMesh:
        """The surface of a tile with its margin, cut at the sides of the tile."""
        cloud = self.store.cloud_in(tile, _OVERLAP_M)
        if cloud is None:
            raise MeshingError("there is no point")
        voxels = self.store.voxels_in(tile, _OVERLAP_M)
        use_voxels = self.settings.free_space and len(voxels) > 0
        mesh = reconstruct_mesh(
            cloud,
            self.settings.model_copy(update={"target_faces": self._target(len(cloud))}),
            wrong=(lambda vertices: looked_through(vertices, voxels)) if use_voxels else None,
        )
        for axis, far in _SIDES:
            mesh = cut_mesh(mesh, self._plane(tile, axis, far), keep_above=not far)
        return mesh

    def _target(self, seen: int) -> int | None:
        """Target number of triangles of a tile with its margin, by its share of the points."""
        target = self.settings.target_faces
        if target is None:
            return None
        return max(4, round(target * seen / self.store.total))

    def _joined(self, tile: Tile, mesh: TriangleMesh) -> TriangleMesh:
        """The mesh of a tile, joined to those of its earlier neighbours."""
        for axis, far in _SIDES:
            plane = self._plane(tile, axis, far)
            step = np.zeros(2, int)
            step[axis] = 1 if far else -1
            neighbour = (tile[0] + int(step[0]), tile[1] + int(step[1]))
            border = self.borders.pop((neighbour, plane), None)
            if border is not None:
                mesh = close_seam(mesh, plane, border, _SEAM_M)
            else:
                self.borders[tile, plane] = open_edges(mesh, plane)
        return mesh

    def _plane(self, tile: Tile, axis: int, far: int) -> Plane:
        return Plane(axis, float(self.store.bounds_m(tile)[far][axis]))
