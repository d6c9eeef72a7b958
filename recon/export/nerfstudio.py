"""The drives of a map for nerfstudio: images, depth, masks of what moved, points to begin with.

Ref: https://docs.nerf.studio/quickstart/data_conventions.html.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply
from recon.core.kernels.voxels import distinct_keys, pack_keys
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float32, Int64
from recon.core.values.camera import project
from recon.export.cloud import even_sample
from recon.export.product import DriveImages, ExportContext, ExportResult, ProductFigures
from recon.io.fields import write_json
from recon.io.images.image import write_image
from recon.io.models.colmap import PIXEL_CENTRE
from recon.io.models.ply import write_ply
from recon.map.sessions.placed import settings_of
from recon.stereo.frame import FrameReconstructor, back_project

_OPENGL: Final = np.diag([1.0, -1.0, -1.0, 1.0])  # x right, y up, looking along -z
_FARTHEST_M: Final = 65.535  # in 16 bits of millimetres
_NAMES: Final = {"images": "file_path", "depths": "depth_file_path", "masks": "mask_path"}
_POINTS: Final = "sparse_pc.ply"


@dataclass(frozen=True)
class NerfstudioFigures(ProductFigures):
    """A data set for nerfstudio."""

    nerfstudio_frames: int


def nerfstudio_product(context: ExportContext, folder: Path) -> ExportResult:
    """Write ``transforms.json`` and what it names, map axes; depth is matched again."""
    drives, tiles = context.drives, context.placed.tiles
    # Packed voxels in which something moved, and those that touch one, sorted.
    steps, found = np.array(list(product((-1, 0, 1), repeat=3))), [np.zeros(0, np.int64)]
    for tile in tiles:
        cells = np.floor(tile.removed.xyz.astype(np.float64) / tiles.config.fusion.voxel_m)
        around = cells.astype(np.int64)[:, None] + steps
        found.append(distinct_keys(pack_keys(around.reshape(-1, 3))))
    moved = distinct_keys(np.concatenate(found))
    whole = all(drive.rectifier.valid is None or drive.rectifier.valid.all() for drive in drives)
    # All frames have a mask, or none: readers count them.
    masked, frames = None if whole and not len(moved) else moved, []
    for drive in drives:
        # Of one drive it is said once; else each frame says its own.
        camera = {} if len(drives) == 1 else _intrinsics(drive.session.camera)
        for frame, images in _frames(context, drive, masked):
            named = {_NAMES[kind]: f"{kind}/{drive.file('left', frame)}" for kind in images}
            for image, name in zip(images.values(), named.values(), strict=True):
                write_image(folder / name, image)
            pose = drive.T_map_camera[frame] @ _OPENGL
            frames.append({**named, "transform_matrix": pose.tolist(), **camera})
    write_ply(folder / _POINTS, even_sample(tiles))
    content = {
        "camera_model": "OPENCV",
        **(_intrinsics(drives[0].session.camera) if len(drives) == 1 else {}),
        "applied_transform": np.eye(4)[:3].tolist(),
        "ply_file_path": _POINTS,
        "frames": frames,
    }
    write_json(folder / "transforms.json", content)
    return ExportResult(NerfstudioFigures(len(frames)))


def _intrinsics(camera: RectifiedCamera) -> dict[str, float]:
    centre = {"cx": camera.cx_px + PIXEL_CENTRE, "cy": camera.cy_px + PIXEL_CENTRE}
    focal = {"fl_x": camera.focal_px, "fl_y": camera.focal_px}
    lens = dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0)
    return {"w": camera.width_px, "h": camera.height_px, **focal, **centre, **lens}


def _frames(
    context: ExportContext, drive: DriveImages, moved: Int64 | None
) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
    """Yield number, image, depth [mm] and perhaps mask of each frame."""
    settings, voxel_m = settings_of(drive.session), context.placed.tiles.config.fusion.voxel_m
    reconstructor = FrameReconstructor(drive.rig, settings, threads=context.threads)
    for frame, pair in drive.pairs():
        rectified, disparity = reconstructor.match(pair)
        xyz = back_project(disparity, rectified, settings.cloud, normals=False).xyz
        depth_m = np.zeros(rectified.left.shape)
        depth_m[pixels_of(xyz, rectified.camera)] = xyz[:, 2]
        depth_m[depth_m > _FARTHEST_M] = 0.0
        images: dict[str, NDArray[Any]] = {"images": rectified.views[0][1]}
        images["depths"] = np.rint(1000.0 * depth_m).astype(np.uint16)
        if moved is not None:
            cells = np.floor(apply(drive.T_map_camera[frame], xyz) / voxel_m).astype(np.int64)
            moving = xyz[np.isin(pack_keys(cells), moved)]
            still = ~shadow(moving, rectified.camera, voxel_m)
            shown = still if rectified.valid is None else still & rectified.valid
            images["masks"] = np.where(shown, 255, 0).astype(np.uint8)
        yield frame, images


def pixels_of(xyz: Float32, camera: RectifiedCamera) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of points (N, 3) that pixels were made of."""
    column, row, _ = project(xyz.astype(np.float64), camera)
    return np.rint(row).astype(np.intp), np.rint(column).astype(np.intp)


def shadow(xyz: Float32, camera: RectifiedCamera, voxel_m: float) -> Bool:
    """Return bool (H, W), where points (N, 3) are, and gaps between them as wide as a voxel."""
    hit = np.zeros((camera.height_px, camera.width_px), np.uint8)
    if len(xyz):
        hit[pixels_of(xyz, camera)] = 1
        wide_px = 1 + 2 * round(camera.focal_px * voxel_m / float(np.median(xyz[:, 2])))
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide_px, wide_px))
        hit = np.asarray(cv2.morphologyEx(hit, cv2.MORPH_CLOSE, kernel), np.uint8)
    return hit > 0
