"""The surface of a map with the images of its drives as its texture: decision 0037."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import MeshingError
from recon.core.summary import optional
from recon.core.text import counted
from recon.core.values import Texture, TriangleMesh
from recon.core.values.image import in_colour
from recon.export.images import DriveImages
from recon.export.mesh.charts import make_atlas
from recon.export.mesh.pieces import SAMPLE_FACES, WHOLE, mesh_product
from recon.export.mesh.surveyed import write_surveyed
from recon.export.mesh.views import BestViews, PosedImage, paint
from recon.export.product import ExportContext, ExportResult, ProductFigures
from recon.io.images.image import write_image
from recon.io.models.mesh import read_mesh, write_mesh
from recon.io.models.mlp import Photo, write_mlp
from recon.map.fusion import fusion_range_m
from recon.map.sessions.placed import settings_of

_WITH_TEXTURE: Final = ("glb", "obj", "ply")
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
