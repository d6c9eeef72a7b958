"""The mesh of a map, made in square pieces that are cut at their borders, to bound memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from recon.core.errors import MeshingError
from recon.core.geometry.se3 import apply, rotate
from recon.core.kernels.voxels import pack_keys, unpack_keys
from recon.core.machine import available_cores
from recon.core.progress import tracked
from recon.core.summary import optional
from recon.core.text import counted
from recon.core.values import TriangleMesh
from recon.core.values.arrays import Float32, Int32, Int64
from recon.core.work import side_by_side
from recon.export.cloud import export_cloud
from recon.export.mesh.cut import (
    Plane,
    close_seam,
    component_labels,
    components,
    cut_mesh,
    nearest_on_edges,
    open_corners,
    with_faces,
)
from recon.export.mesh.poisson import (
    OVERLAP_M,
    MeshSettings,
    reconstruct_map_surface,
    reconstruct_mesh,
)
from recon.export.product import ExportContext, ExportResult, ProductFigures
from recon.io.atomic import write_text
from recon.io.models.las import check_crs
from recon.io.models.mesh import join_meshes, read_mesh, write_mesh, write_mlp
from recon.map.cut import Rectangle
from recon.map.occupancy.moving import looked_through
from recon.map.sessions.placed import has_occupancy
from recon.map.tiles import Tiles

WHOLE: Final = "mesh/mesh.ply"
LAYER: Final = "mesh/cloud.ply"  # of the MeshLab project, where there is no other cloud
SAMPLE_FACES: Final = 2_000_000  # most triangles of a mesh that is loaded whole for images
_MOST_AT_ONCE: Final = 4
_SIDES: Final = ((0, 0), (0, 1), (1, 0), (1, 1))  # of a piece: axis, 1 for the far side
# Lengths are those on a road: they are times the scale of the scene.
_SEAM_M: Final = 0.15  # widest gap that is closed where two pieces meet
_BULGE_M: Final = 2.0  # how far a surface may go beyond the points that it is made of
PieceKey = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class MeshFigures(ProductFigures):
    """The surface of a map; without points there is none."""

    points: int | None = optional()  # of the cloud that it is made of
    vertices: int | None = optional()
    faces: int = 0
    tiles: int | None = optional()  # pieces that it was made in
    mesh_offset_m: Sequence[float] | None = optional()  # to be added for survey coordinates
    mesh_coverage: float | None = optional()  # fraction of the measured points on it, of a pair

    @property
    def text(self) -> str:
        covered = self.mesh_coverage
        on = "" if covered is None else f", on it {100 * covered:.0f} % of the measured points"
        return f"{self.faces:,} faces{on}"


class MadeMesh(NamedTuple):
    """What is left of a surface that was written."""

    figures: MeshFigures
    warnings: Sequence[str]


class MeshPiece(NamedTuple):
    """The PLY file of a piece, and numbers of its vertices and faces."""

    path: Path
    vertices: int
    faces: int


class Border(NamedTuple):
    """Open edges of a piece in a plane, float32 (E, 2, 3), and the components that they are of."""

    edges: Float32
    components: Int64


def mesh_product(context: ExportContext, path: Path) -> ExportResult:
    """Write the surface, with other formats, its pieces and a MeshLab project beside it.

    The cloud of the project is that of the folder two levels up, else it is made. With a survey,
    ``survey/`` has the surface in its coordinates.
    """
    tiles, cloud = context.placed.tiles, path.parents[1] / "map" / "cloud.ply"
    if not cloud.is_file():
        cloud = path.with_name(Path(LAYER).name)
        export_cloud(tiles, cloud)
    # Each piece being meshed takes memory of its own.
    at_once = context.threads if tiles.config.memory.limit_mb is None else 1
    made = export_mesh(tiles, context.mesh, path, cloud, at_once)
    for suffix in dict.fromkeys(context.formats):
        if suffix != "ply":
            write_mesh(path.with_suffix(f".{suffix}"), read_mesh(path), "map")
    warnings = [*made.warnings]
    if not has_occupancy(context.map):
        warnings.append("the map kept no rays: which faces lie in free space is not known")
    small = made.figures.faces <= SAMPLE_FACES
    mesh = read_mesh(path) if small or context.survey is not None else None
    survey = path.with_name("survey")
    offset_m = None if mesh is None else write_surveyed(context, mesh, survey, context.formats)
    figures = replace(made.figures, mesh_offset_m=offset_m)
    return ExportResult(figures, warnings, mesh if small else None)


def export_mesh(
    tiles: Tiles, settings: MeshSettings, path: Path, cloud: Path, threads: int | None = None
) -> MadeMesh:
    """Write the surface of a map, its pieces if there are several, and a MeshLab project.

    Args:
        tiles: The map; without voxels no space is known to be free.
        settings: Settings of the mesh; ``target_faces`` is the total over all pieces.
        path: The PLY file; pieces go to ``tiles/`` beside it.
        cloud: A PLY file, for the MeshLab project.
        threads: Pieces made at a time, at most four: each needs memory; None = one per core.
    """
    at_once = min(threads or available_cores(), _MOST_AT_ONCE)
    points = _count(tiles, settings)
    pieces, warnings = _Mesher(tiles, settings, path.with_name("tiles"), at_once, points).written()
    if not pieces:
        small = f"no component of {counted(settings.min_component_faces, 'face')}"
        got = "; ".join(warnings) or (small if points else "no point")
        raise MeshingError("no part of the map gives a surface", got=got)
    join_meshes(path, pieces)
    layers = {piece.path.stem: piece.path for piece in pieces}
    if len(pieces) == 1:
        pieces[0].path.unlink()
        layers = {"mesh": path}
    write_mlp(path.with_suffix(".mlp"), {**layers, "cloud": cloud}, "map")
    vertices, faces = (sum(numbers) for numbers in [*zip(*pieces, strict=True)][1:])
    figures = MeshFigures(points=points.total(), vertices=vertices, faces=faces, tiles=len(pieces))
    return MadeMesh(figures, warnings)


def _count(tiles: Tiles, settings: MeshSettings) -> Counter[PieceKey]:
    """Return the points in each piece, which are centred at multiples of their edge."""
    found: Counter[PieceKey] = Counter()
    for tile in tiles:
        homes = np.floor(tile.cloud.xyz[:, :2] / settings.tile_m + 0.5).astype(np.int64)
        # Packed into one integer, since numpy sorts rows slowly.
        keys, counts = np.unique(pack_keys(np.pad(homes, ((0, 0), (0, 1)))), return_counts=True)
        places = ((x, y) for x, y, _ in unpack_keys(keys).tolist())
        found.update(dict(zip(places, counts.tolist(), strict=True)))
        len(tile.voxels)  # made here, and not by several threads at once
    return found


@dataclass(eq=False)
class _Mesher:
    """Reconstructs pieces in parallel; each closes its seams to earlier ones, in order.

    Components are numbered over all pieces. Those that meet in a seam are one, and whether that is
    large enough is known at the end; if faces are simplified, in each piece and its margin before.
    """

    tiles: Tiles
    settings: MeshSettings
    folder: Path
    threads: int
    points: Counter[PieceKey]
    borders: dict[tuple[PieceKey, Plane], Border] = field(default_factory=dict)
    sizes: list[Int32] = field(default_factory=list)  # of components, faces; for each piece
    seams: list[Int64] = field(default_factory=list)  # (N, 2), components that meet

    def written(self) -> tuple[list[MeshPiece], list[str]]:
        """Return the pieces whose files are written, and what could not be meshed."""
        paths: list[Path] = []
        failed: dict[PieceKey, MeshingError] = {}
        keys = sorted(self.points)
        surfaces = side_by_side(self._surface, keys, threads=self.threads)
        for key, surface in tracked(zip(keys, surfaces, strict=True), "pieces", total=len(keys)):
            if isinstance(surface, MeshingError):
                failed[key] = surface
                continue
            mesh = self._joined(key, surface)
            if len(mesh.faces):
                paths.append(self.folder / f"tile_{key[0]}_{key[1]}.ply")
                write_mesh(paths[-1], mesh)
        # Components of enough faces, with those that they meet in seams.
        sizes = np.concatenate([np.zeros(0, np.int32), *self.sizes])
        met = np.concatenate([np.zeros((0, 2), np.int64), *self.seams])
        whole = components(met, len(sizes))
        least = self.settings.min_component_faces if self.settings.target_faces is None else 1
        large = (np.bincount(whole, sizes) >= least)[whole]
        ends = np.cumsum([*map(len, self.sizes)], dtype=np.int64)
        kept = np.split(large, ends)[: len(paths)]
        pieces = []
        for path, own in zip(paths, kept, strict=True):
            mesh = read_mesh(path)
            if not own.all():  # it is written again, if anything is left
                mesh = with_faces(mesh, mesh.faces[own[component_labels(mesh.faces)[0]]])
                write_mesh(path, mesh) if len(mesh.faces) else path.unlink()
            if len(mesh.faces):
                pieces.append(MeshPiece(path, len(mesh.vertices), len(mesh.faces)))
        return pieces, self._warnings(failed)

    def _warnings(self, failed: dict[PieceKey, MeshingError]) -> list[str]:
        """Return a line about the pieces without a surface, naming the one with the most points."""
        if not failed:
            return []
        worst = max(failed, key=self.points.__getitem__)
        ratio = sum(self.points[key] for key in failed) / self.points.total()
        tiles = f"{len(failed)} of {counted(len(self.points), 'tile')}"
        return [f"no surface in {tiles}, {ratio:.1%} of the points ({failed[worst]})"]

    def _surface(self, key: PieceKey) -> TriangleMesh | MeshingError:
        """Return the surface of a piece with its margin, cut at its sides, or why there is none."""
        scale = self.tiles.config.scale
        wide = self._bounds(key).wider(scale * OVERLAP_M)
        cloud = self.tiles.cloud_in(wide)
        voxels = self.tiles.voxels_in(wide.wider(scale * _BULGE_M))
        wrong = partial(looked_through, voxels=voxels) if len(voxels) else None
        settings, target = self.settings, self.settings.target_faces
        if target is not None:
            # By its fraction of the points.
            target = max(4, round(target * len(cloud) / self.points.total()))
            settings = settings.model_copy(update={"target_faces": target})
        else:
            settings = settings.model_copy(update={"min_component_faces": 1})
        try:
            if settings.surface == "grid":
                voxel_m = self.tiles.config.fusion.voxel_m
                mesh = reconstruct_map_surface(cloud, settings, voxel_m, wrong)
            else:
                mesh = reconstruct_mesh(cloud, settings, wrong=wrong)
        except MeshingError as error:
            return error
        for axis, far in _SIDES:
            mesh = cut_mesh(mesh, self._plane(key, axis, far), keep_above=not far)
        return mesh

    def _joined(self, key: PieceKey, mesh: TriangleMesh) -> TriangleMesh:
        """Return the mesh of a piece, joined to those of its earlier neighbours."""
        borders: dict[Plane, Border | None] = {}
        reach_m = self.tiles.config.scale * _SEAM_M
        for axis, far in _SIDES:
            plane, step = self._plane(key, axis, far), 2 * far - 1
            neighbour = (key[0], key[1] + step) if axis else (key[0] + step, key[1])
            border = borders[plane] = self.borders.pop((neighbour, plane), None)
            if border is not None:
                mesh = close_seam(mesh, plane, border.edges, reach_m)
        if not len(mesh.faces):
            return mesh
        labels, sizes = component_labels(mesh.faces)
        first = sum(map(len, self.sizes))
        self.sizes.append(sizes)
        for plane, border in borders.items():
            corners = open_corners(mesh, plane)
            components = labels[corners[:, 3]].astype(np.int64) + first
            own = Border(mesh.vertices[corners[:, :2]], components)
            if border is None:
                self.borders[key, plane] = own
            elif len(own.edges) and len(border.edges):
                found = nearest_on_edges(own.edges.mean(axis=1), border.edges)
                met = found.distance_m <= reach_m
                pairs = own.components[met], border.components[found.edge[met]]
                self.seams.append(np.stack(pairs, axis=1))
        return mesh

    def _bounds(self, key: PieceKey) -> Rectangle:
        (x, y), edge_m, half_m = key, self.settings.tile_m, self.settings.tile_m / 2
        return Rectangle(
            (x * edge_m - half_m, y * edge_m - half_m), (x * edge_m + half_m, y * edge_m + half_m)
        )

    def _plane(self, key: PieceKey, axis: int, far: int) -> Plane:
        sides = self._bounds(key)
        return Plane(axis, (sides.high if far else sides.low)[axis])


_ROUND_M: Final = 100.0


def write_surveyed(
    context: ExportContext, mesh: TriangleMesh, folder: Path, formats: Sequence[str]
) -> Sequence[float] | None:
    """Write a mesh, map axes, once more into a folder; return what is to be added, metres.

    Its axes are east, north and up. ``offset.xyz`` has what is to be added to its coordinates:
    hundreds of metres to the east and north; ``mesh.prj`` the coordinate system, if it is known.
    Without a survey nothing is written.
    """
    if context.survey is None:
        return None
    T_survey_map = context.T_survey_map
    offset_m = np.array([*(np.floor(T_survey_map[:2, 3] / _ROUND_M) * _ROUND_M), 0.0])
    T_mesh_map = T_survey_map.copy()
    T_mesh_map[:3, 3] -= offset_m
    normals = None if mesh.normals is None else rotate(T_mesh_map, mesh.normals.astype(np.float64))
    moved = replace(
        mesh,
        vertices=apply(T_mesh_map, mesh.vertices.astype(np.float64)).astype(np.float32),
        normals=None if normals is None else normals.astype(np.float32),
    )
    for suffix in dict.fromkeys(formats):
        write_mesh(folder / f"mesh.{suffix}", moved, "map")
    text = " ".join(f"{metres:.0f}" for metres in offset_m)
    write_text(folder / "offset.xyz", f"{text}\n")
    if context.crs is not None:
        wkt = check_crs(context.crs).to_wkt("WKT1_ESRI")
        write_text(folder / "mesh.prj", f"{wkt}\n")
    return list(offset_m.tolist())
