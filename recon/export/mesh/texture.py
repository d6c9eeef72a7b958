"""The surface of a map with the images of its drives as its texture: decision 0037.

Every vertex takes its colour from a few images: those that see it largest, least aslant and not at
their border, with nothing in between. Between vertices their weights are interpolated, so there is
no seam. Images differ in exposure: gains are found from the vertices that several see. What agrees
less with the colour of the fused points, such as something that passed by, counts less.

Ref: M. Waechter, N. Moehrle, M. Goesele, "Let there be color! Large-scale texturing of 3D
reconstructions", ECCV 2014 (what an image is chosen by); M. Callieri et al., "Masked photo
blending: mapping dense photographic data set on high-resolution sampled 3D models", Computers and
Graphics 32(4), 2008 (weights instead of seams).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from recon.core.errors import MeshingError
from recon.core.geometry.se3 import apply, invert
from recon.core.open3d_raycasting import RayScene
from recon.core.summary import optional
from recon.core.text import counted
from recon.core.values import RectifiedCamera, Texture, TriangleMesh
from recon.core.values.arrays import Float32, Float64, Int32, Int64, UInt8
from recon.core.values.camera import project
from recon.core.values.image import in_colour
from recon.export.mesh.charts import MARGIN_PX, Atlas, make_atlas, ratios_of, texels_of
from recon.export.mesh.pieces import SAMPLE_FACES, WHOLE, mesh_product, write_surveyed
from recon.export.product import DriveImages, ExportContext, ExportResult, ProductFigures
from recon.io.images.image import write_image
from recon.io.models.mesh import Photo, read_mesh, write_mesh, write_mlp
from recon.map.fusion import fusion_range_m
from recon.map.sessions.placed import settings_of

_WITH_TEXTURE: Final = ("glb", "obj", "ply")
_VIEWS: Final = 3  # images that a vertex takes its colour from
_BORDER: Final = (
    0.1  # fraction of the width of an image over which it counts less towards its border
)
_LEAST_COSINE: Final = 0.1
_SHARPNESS: Final = 4  # power of the scores: of images that differ, the best alone
_DARK, _BRIGHT = 8, 247  # beyond, exposures cannot be compared
_ANCHOR: Final = 0.1  # how much the colour of a vertex counts beside that of another image
_NONE: Final = -1
_NOTHING: Final = 1e-6  # weight that is but a rounding error
_AT_ONCE: Final = 1 << 19  # texels, which takes some hundred megabytes


class PosedImage(NamedTuple):
    """A rectified image, and where it was taken."""

    number: int  # from 0
    image: UInt8  # (H, W, 3)
    camera: RectifiedCamera
    T_map_camera: Float64


Views = Callable[[], Iterable[PosedImage]]
"""Gives the same images again each time it is called, one in memory at a time."""


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
    best, count = BestViews(mesh, edge_m), 0
    for view in views():
        best.add(view, range_m)
        count = view.number + 1
    seen = np.isfinite(best.footprint_m)
    if not seen.any():
        raise MeshingError("no image of the drive sees the surface", got=counted(count, "image"))
    atlas = make_atlas(mesh, float(np.median(best.footprint_m[seen])), most_px)
    picture = paint(atlas, best, best.gains(count), views())
    uv = (atlas.places / [atlas.width_px, atlas.height_px]).astype(np.float32)
    # Colours of vertices would darken the picture in some viewers.
    textured = replace(atlas.mesh, rgb=None, texture=Texture(picture, uv))
    size_px = max(atlas.width_px, atlas.height_px)
    return textured, TextureFigures(size_px, atlas.texel_m, float(seen.mean()))


def posed_images(drives: Sequence[DriveImages]) -> Iterator[PosedImage]:
    """Yield the left images of all frames that have a place, numbered over all drives."""
    first = 0
    for drive in drives:
        for frame, images in drive.views():
            colours = in_colour(images[0])
            camera, T_map_camera = drive.session.camera, drive.T_map_camera[frame]
            yield PosedImage(first + frame, colours, camera, T_map_camera)
        first += len(drive.placed)


def _photos(folder: Path, drives: Sequence[DriveImages]) -> Iterator[Photo]:
    """Write the left images of the keyframes, and yield them."""
    for drive in drives:
        keyframes = {*np.asarray(drive.session.keyframes.frames).tolist()}
        for frame, images in drive.views():
            if frame in keyframes:
                path = folder / drive.file("left", frame)
                write_image(path, images[0])
                yield Photo(path, drive.session.camera, drive.T_map_camera[frame])


class BestViews:
    """The images that see each vertex of a mesh best, found one after the other.

    Attributes:
        frames: int32 (V, 3), numbers of images, the best first; -1 = none.
        scores: float32 (V, 3), pixels per area, reduced towards the border of the image.
        rgb: uint8 (V, 3, 3), how the images see the vertex.
        footprint_m: float32 (V,), width of a pixel of the best image there; infinity = none.
    """

    def __init__(self, mesh: TriangleMesh, edge_m: float) -> None:
        self._mesh, self._edge_m = mesh, edge_m
        self._scene = RayScene(mesh.vertices[mesh.faces])
        self._tree = cKDTree(mesh.vertices)
        count = len(mesh.vertices)
        self.frames = np.full((count, _VIEWS), _NONE, np.int32)
        self.scores = np.zeros((count, _VIEWS), np.float32)
        self.rgb = np.zeros((count, _VIEWS, 3), np.uint8)
        self.footprint_m = np.full(count, np.inf, np.float32)

    def add(self, view: PosedImage, range_m: float) -> None:
        """Compare an image with those before; what is farther than ``range_m`` is not looked at."""
        eye = view.T_map_camera[:3, 3]
        rows = np.array(self._tree.query_ball_point(eye, range_m, return_sorted=True), np.int64)
        if not len(rows):
            return
        u, v, score = self._scored(rows, view)
        better = np.flatnonzero(score > self.scores[rows, -1])
        reach = self._mesh.vertices[rows[better]] - eye
        length = np.linalg.norm(reach, axis=1, keepdims=True)
        # A surface lies up to an edge of its triangles before the vertex, where it is rough.
        short = np.maximum(1 - 2 * self._edge_m / length, 0)
        free = ~self._scene.blocked(eye, reach * short)
        kept, length = better[free], length[free, 0]
        rows, u, v, score = rows[kept], u[kept], v[kept], score[kept]
        rgb = view.image[np.rint(v).astype(np.intp), np.rint(u).astype(np.intp)]
        first = score > self.scores[rows, 0]
        self.footprint_m[rows[first]] = length[first] / view.camera.focal_px
        place = (self.scores[rows] >= score[:, None]).sum(axis=1)
        for values, new in ((self.frames, view.number), (self.scores, score), (self.rgb, rgb)):
            _insert(values, rows, place, new)

    def _scored(self, rows: Int64, view: PosedImage) -> tuple[Float64, Float64, Float32]:
        """Return column, row and score of vertices in an image; 0 = not seen."""
        xyz = apply(invert(view.T_map_camera), self._mesh.vertices[rows].astype(np.float64))
        u, v, _ = project(xyz, view.camera)
        height, width = view.image.shape[:2]
        # NaN, of what is behind, fails the comparison.
        inside = np.minimum(np.minimum(u, width - 1 - u), np.minimum(v, height - 1 - v))
        fade = np.where(inside > 0, np.minimum(inside / (_BORDER * width), 1), 0)
        away2 = np.maximum(np.einsum("ij,ij->i", xyz, xyz), 1e-12)
        to_eye = view.T_map_camera[:3, 3] - self._mesh.vertices[rows]
        normals = np.asarray(self._mesh.normals)[rows]
        cosine = np.einsum("ij,ij->i", normals, to_eye) / np.sqrt(away2)
        pixels = view.camera.focal_px**2 * cosine / away2
        return u, v, np.where(cosine > _LEAST_COSINE, fade * pixels, 0).astype(np.float32)

    def gains(self, count: int) -> Float64:
        """Return float64 (count,), factors that make images equally bright where they overlap.

        They are as bright as the colours of the vertices, as far as overlaps leave that open.
        """
        matrix, right = np.eye(count) * _ANCHOR, np.zeros(count)
        greys = [self.rgb[:, view].mean(axis=1) for view in range(_VIEWS)]
        for one, other in ((0, 1), (0, 2), (1, 2)):
            i, j, step = self._compared(one, greys[one], greys[other], self.frames[:, other])
            for row, column, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
                np.add.at(matrix, (row, column), sign)
            np.add.at(right, i, step)
            np.add.at(right, j, -step)
        if self._mesh.rgb is not None:
            fused = self._mesh.rgb.mean(axis=1)
            for view in range(_VIEWS):
                i, _, step = self._compared(view, greys[view], fused, self.frames[:, view])
                np.add.at(matrix, (i, i), _ANCHOR)
                np.add.at(right, i, _ANCHOR * step)
        return np.asarray(np.exp(np.linalg.solve(matrix, right)))

    def _compared(
        self, view: int, grey: Float64, other: Float64, others: Int32
    ) -> tuple[Int32, Int32, Float64]:
        """Return images, those beside them, and by how much these are brighter (logarithms)."""
        rows = (self.frames[:, view] != _NONE) & (others != _NONE)
        for one in (grey, other):
            rows &= (one > _DARK) & (one < _BRIGHT)
        return self.frames[rows, view], others[rows], np.log(other[rows] / grey[rows])

    def weights(self, gains: Float64) -> Float32:
        """Return float32 (V, 3): how much each image counts, together 1, or 0 where none sees."""
        known = self.frames != _NONE
        weights = (self.scores / np.maximum(self.scores[:, :1], 1e-30)) ** _SHARPNESS
        if self._mesh.rgb is not None:
            seen = gains[self.frames][..., None] * self.rgb
            off = np.abs(seen - self._mesh.rgb[:, None]).mean(axis=2)
            usual = max(3 * float(np.median(off[known])), 1.0) if known.any() else 1.0
            weights = weights * np.exp(-0.5 * (off / usual) ** 2)
        weights = np.where(known, np.maximum(weights, 1e-12), 0)
        total = np.maximum(weights.sum(axis=1, keepdims=True), 1e-30)
        return np.asarray(weights / total, np.float32)


def _insert(values: NDArray[Any], rows: Int64, place: Int64, new: Any) -> None:
    """Put new values at places of rows (N,); what was there moves on, the last goes."""
    for column in range(_VIEWS - 1, 0, -1):
        later = place < column
        values[rows[later], column] = values[rows[later], column - 1]
    values[rows, place] = new


def paint(atlas: Atlas, best: BestViews, gains: Float64, views: Iterable[PosedImage]) -> UInt8:
    """Return the picture (H, W, 3) of an atlas; what no image sees has the colours of vertices."""
    canvas = _Canvas(atlas)
    frames, weights = best.frames[atlas.vertex_of], best.weights(gains)[atlas.vertex_of]
    if atlas.mesh.rgb is not None:
        rgb = atlas.mesh.rgb.astype(np.float32)
        canvas.add(1 - weights.sum(axis=1), lambda at: at.mean_of(rgb))
    for view in views:
        own = (np.where(frames[:, k] == view.number, weights[:, k], 0) for k in range(_VIEWS))
        weight = sum(own, np.zeros(len(frames), np.float32))
        canvas.add(weight, partial(_seen_by, view, gains[view.number], atlas.mesh.vertices))
    return canvas.picture()


class _Texels(NamedTuple):
    """Texels of faces."""

    corners: Int32  # (N, 3), vertices of the face
    ratios: Float32  # (N, 3), how much each counts

    def mean_of(self, values: Float32) -> Float32:
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
        self._colours = np.zeros((len(context), 3), np.float16)

    def add(self, weight: Float32, colour_of: Callable[[_Texels], Float32]) -> None:
        """Add colours of texels times the weights (V,) of vertices, interpolated."""
        faces, known = self._atlas.mesh.faces, weight > _NOTHING
        rows = np.flatnonzero(reduce(np.logical_or, (known[corner] for corner in faces.T)))
        begin = self._begin[rows]
        size = self._begin[rows + 1] - begin
        texels = np.repeat(begin - np.cumsum(size) + size, size) + np.arange(size.sum())
        if not len(texels):
            return
        for part in np.array_split(texels, 1 + len(texels) // _AT_ONCE):
            face = self._faces[part]
            at = _Texels(faces[face], ratios_of(self._atlas, self._numbers[part], face))
            weighted = at.mean_of(weight[:, None]) * colour_of(at)
            self._colours[part] += weighted.astype(np.float16)

    def picture(self) -> UInt8:
        """Return the picture (H, W, 3), with what is around charts painted as they are."""
        shape = (self._atlas.height_px, self._atlas.width_px)
        image, painted = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.bool_)
        colours = np.clip(np.rint(self._colours), 0, 255).astype(np.uint8)
        image.reshape(-1, 3)[self._numbers] = colours
        painted.ravel()[self._numbers] = True
        kernel = np.ones((3, 3), np.uint8)
        for _ in range(MARGIN_PX):
            image = np.where(painted[..., None], image, cv2.dilate(image, kernel))
            painted = cv2.dilate(painted.astype(np.uint8), kernel) > 0
        return image


def _seen_by(view: PosedImage, gain: float, vertices: Float32, at: _Texels) -> Float32:
    """Return float32 (N, 3), the colours of an image at texels, times a gain."""
    u, v, _ = project(apply(invert(view.T_map_camera), at.mean_of(vertices)), view.camera)
    width = 1 << 14  # OpenCV takes no longer rows
    where = np.zeros((2, -(-len(u) // width), width), np.float32)
    where.reshape(2, -1)[:, : len(u)] = np.nan_to_num([u, v])
    found = cv2.remap(
        view.image, where[0], where[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(gain * found.reshape(-1, 3)[: len(u)], np.float32)
