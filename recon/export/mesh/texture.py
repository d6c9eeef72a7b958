"""The surface of a map with the images of its drives as its texture: decisions 0037, 0078.

Every texel has the mean colour of the images that see it with nothing in between, each weighted by
how large it sees the surface there, and less at its border. Weights are those of vertices, and
interpolated, so there is no seam. Images differ in exposure: gains are found from vertices that
several see. What is far from the colour of the fused points, such as what passed by, counts less.

Ref: M. Waechter, N. Moehrle, M. Goesele, "Let there be color! Large-scale texturing of 3D
reconstructions", ECCV 2014 (what an image is chosen by); M. Callieri et al., "Masked photo
blending: mapping dense photographic data set on high-resolution sampled 3D models", Computers and
Graphics 32(4), 2008 (weights instead of seams).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import MeshingError
from recon.core.open3d_raycasting import RayScene
from recon.core.summary import optional
from recon.core.text import counted
from recon.core.values import Texture, TriangleMesh
from recon.core.values.arrays import Float32, Int32, Int64, UInt8
from recon.export.mesh.charts import MARGIN_PX, Atlas, make_atlas, ratios_of, texels_of
from recon.export.mesh.pieces import SAMPLE_FACES, WHOLE, mesh_product, write_surveyed
from recon.export.mesh.views import Exposures, Sight, Views, posed_images
from recon.export.product import DriveImages, ExportContext, ExportResult, ProductFigures
from recon.io.images.image import write_image
from recon.io.models.mesh import Photo, read_mesh, write_mesh, write_mlp
from recon.map.fusion import fusion_range_m
from recon.map.sessions.placed import settings_of

_WITH_TEXTURE: Final = ("glb", "obj", "ply")
_BORDER: Final = 0.02  # of its width: over that, an image counts less towards its border
_LEAST_COSINE: Final = 0.05  # that a surface counts as, seen along itself or from behind
_SHARPNESS: Final = 1.5  # power of how large an image sees the surface
_FARTHEST: Final = 2.0  # times the range up to which points are fused: how far images are used
_PASSED: Final = 15.0  # times what is usual: so far from the fused colours is what passed by
_AT_ONCE: Final = 1 << 19  # texels, which takes some hundred megabytes


@dataclass(frozen=True)
class TextureFigures(ProductFigures):
    """The picture on a surface."""

    texture_px: int  # its larger side
    texel_m: float
    textured: float  # fraction of the faces that an image sees
    mesh_offset_m: Sequence[float] | None = optional()  # to be added for survey coordinates

    @property
    def text(self) -> str:
        return f"{self.texture_px} px, {100 * self.textured:.0f} % of the faces seen"


def texture_product(context: ExportContext, path: Path) -> ExportResult:
    """Write the surface and its picture, and beside it a MeshLab project with the keyframes.

    The formats are those of the mesh that hold a texture, GLB if there is none. The surface is that
    of the folder two levels up, which is made if it is not there.
    """
    drives, whole = context.drives, path.parents[1] / WHOLE
    made = None if whole.is_file() else mesh_product(context, whole)
    mesh = read_mesh(whole)
    if len(mesh.faces) > SAMPLE_FACES:
        what, hint = "the mesh is too large for one texture", "--set mesh.target_faces=1000000"
        raise MeshingError(what, got=counted(len(mesh.faces), "face"), hint=hint)
    edge_m, settings = context.placed.tiles.config.fusion.voxel_m, context.mesh
    range_m = max(fusion_range_m(d.session.camera, settings_of(d.session).fusion) for d in drives)
    textured, figures = textured_mesh(
        mesh, lambda: posed_images(drives), edge_m, range_m, settings.texture_px
    )
    chosen = [name for name in context.formats if name in _WITH_TEXTURE]
    named = [name for name in chosen if chosen != ["ply"]] or ["glb"]
    for suffix in dict.fromkeys(named):
        write_mesh(path.with_suffix(f".{suffix}"), textured, "map")
    photos = [*_photos(path.with_name("images"), drives)]
    write_mlp(path.with_suffix(".mlp"), {"mesh": whole}, "map", photos)
    offset_m = write_surveyed(context, textured, path.with_name("survey"), named)
    figures = replace(figures, mesh_offset_m=offset_m)
    return ExportResult(figures, () if made is None else made.warnings)


def textured_mesh(
    mesh: TriangleMesh, views: Views, edge_m: float, range_m: float, most_px: int
) -> tuple[TriangleMesh, TextureFigures]:
    """Return a mesh in charts whose picture is painted by images; and figures of it.

    Args:
        mesh: The surface, with normals; its colours are for what no image sees.
        views: Gives the images; they are gone through twice.
        edge_m: Usual edge of its triangles.
        range_m: Distance up to which images are looked at.
        most_px: Largest width and height of the picture.

    Raises:
        MeshingError: No image sees any of the surface, or its charts do not fit into the picture.
    """
    exposures, scene, count = Exposures(mesh), RayScene(mesh.vertices[mesh.faces]), 0
    for view in views():
        exposures.add(Sight(view, scene, edge_m))
        count = view.number + 1
    seen = np.isfinite(exposures.footprint_m)
    if not seen.any():
        raise MeshingError("no image of the drive sees the surface", got=counted(count, "image"))
    # As wide as a pixel, what lies between two of its texels would be smoothed away.
    texel_m = float(np.median(exposures.footprint_m[seen])) / math.sqrt(2)
    atlas = make_atlas(mesh, texel_m, most_px)
    gains, usual = exposures.evened(count)
    canvas = _Canvas(atlas)
    for view in views():
        sight, gain = Sight(view, scene, edge_m), gains[view.number]
        canvas.add(_weights(atlas, sight, range_m, (gain, usual)), sight, gain)
    uv = (atlas.places / [atlas.width_px, atlas.height_px]).astype(np.float32)
    # Colours of vertices would darken the picture in some viewers.
    textured = replace(atlas.mesh, rgb=None, texture=Texture(canvas.picture(), uv))
    size_px = max(atlas.width_px, atlas.height_px)
    return textured, TextureFigures(size_px, atlas.texel_m, canvas.seen())


def _photos(folder: Path, drives: Sequence[DriveImages]) -> Iterator[Photo]:
    """Write the left images of the keyframes, and yield them."""
    for drive in drives:
        keyframes = {*np.asarray(drive.session.keyframes.frames).tolist()}
        for frame, images in drive.views():
            if frame in keyframes:
                path = folder / drive.file("left", frame)
                write_image(path, images[0])
                yield Photo(path, drive.session.camera, drive.T_map_camera[frame])


def _weights(atlas: Atlas, sight: Sight, range_m: float, exposure: tuple[float, float]) -> Float32:
    """Return float32 (V,), how much an image counts at each vertex; 0 = it is not there."""
    mesh, view, (gain, usual) = atlas.mesh, sight.view, exposure
    weights = np.zeros(len(mesh.vertices), np.float32)
    *_, depth, inside = sight.project(mesh.vertices)
    rows = np.flatnonzero((inside > 0) & (depth < _FARTHEST * range_m))
    to_eye = (sight.eye - mesh.vertices[rows]).astype(np.float32)
    away2 = np.einsum("ij,ij->i", to_eye, to_eye)
    cosine = np.einsum("ij,ij->i", np.asarray(mesh.normals)[rows], to_eye) / np.sqrt(away2)
    pixels = (view.camera.focal_px * atlas.texel_m) ** 2 / away2 * np.maximum(cosine, _LEAST_COSINE)
    fade = np.minimum(inside[rows] / (_BORDER * view.image.shape[1]), 1)
    weights[rows] = (fade * pixels) ** _SHARPNESS
    if mesh.rgb is not None:
        rgb, seen = sight.look(mesh.vertices[rows])
        off = np.abs(gain * rgb - mesh.rgb[rows]).mean(axis=1) / (_PASSED * max(usual, 1.0))
        off[~seen] = 0
        weights[rows] *= np.exp(-0.5 * off**2)
    return weights


class _Texels(NamedTuple):
    """Texels of faces."""

    corners: Int32  # (N, 3), vertices of the face
    ratios: Float32  # (N, 3), how much each counts

    def mean_of(self, values: NDArray[Any]) -> Float32:
        """Return the values (V, C) of vertices, interpolated: float32 (N, C)."""
        each = zip(self.ratios.T, self.corners.T, strict=True)  # twice as fast as einsum
        return reduce(np.add, (ratio[:, None] * values.take(corner, 0) for ratio, corner in each))


class _Canvas:
    """The picture of an atlas while it is painted."""

    def __init__(self, atlas: Atlas) -> None:
        self._atlas = atlas
        numbers, faces = texels_of(atlas)
        context = np.argsort(faces, kind="stable").astype(np.int32)
        self._numbers, self._faces = numbers[context], faces[context]
        self._begin = np.searchsorted(self._faces, np.arange(len(atlas.mesh.faces) + 1))
        # Sums of red, green, blue and weights.
        self._sums = np.zeros((len(context), 4), np.float32)

    def add(self, weight: Float32, sight: Sight, gain: float) -> None:
        """Add what an image shows, times a gain, weighted as interpolated from vertices (V,)."""
        mesh, known = self._atlas.mesh, weight > 0
        rows = np.flatnonzero(reduce(np.logical_or, (known[corner] for corner in mesh.faces.T)))
        begin = self._begin[rows]
        size = self._begin[rows + 1] - begin
        texels = np.repeat(begin - np.cumsum(size) + size, size) + np.arange(size.sum())
        for part in np.array_split(texels, 1 + len(texels) // _AT_ONCE):
            at = self._at(part)
            rgb, seen = sight.look(at.mean_of(mesh.vertices))
            weights = np.where(seen, at.mean_of(weight[:, None])[:, 0], 0)[:, None]
            self._sums[part] += np.concatenate([gain * weights * rgb, weights], axis=1)

    def _at(self, texels: Int64) -> _Texels:
        face = self._faces[texels]
        ratios = ratios_of(self._atlas, self._numbers[texels], face)
        return _Texels(self._atlas.mesh.faces[face], ratios)

    def seen(self) -> float:
        """Return the fraction of the faces that an image has painted some of."""
        return len(np.unique(self._faces[self._sums[:, 3] > 0])) / len(self._atlas.mesh.faces)

    def picture(self) -> UInt8:
        """Return the picture (H, W, 3), with what is around charts painted as they are.

        What no image sees has the colours of vertices.
        """
        shape = (self._atlas.height_px, self._atlas.width_px)
        image, painted = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.bool_)
        rgb = self._atlas.mesh.rgb
        for part in np.array_split(np.arange(len(self._sums)), 1 + len(self._sums) // _AT_ONCE):
            sums = self._sums[part]
            colours = sums[:, :3] / np.maximum(sums[:, 3:], 1e-30)
            bare = np.flatnonzero(sums[:, 3] == 0)
            if rgb is not None:
                colours[bare] = self._at(part[bare]).mean_of(rgb)
            colours = np.clip(np.rint(colours), 0, 255).astype(np.uint8)
            image.reshape(-1, 3)[self._numbers[part]] = colours
        painted.ravel()[self._numbers] = True
        kernel = np.ones((3, 3), np.uint8)
        for _ in range(MARGIN_PX):
            image = np.where(painted[..., None], image, cv2.dilate(image, kernel))
            painted = cv2.dilate(painted.astype(np.uint8), kernel) > 0
        return image
