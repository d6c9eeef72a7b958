"""The map from above as its images show it, in cells as fine as their pixels: decision 0077.

The relief is what is highest in each cell of the cloud, up to the height of the camera, which does
not see the tops of what is higher. A place of it takes its colour from the image that has most
pixels there, not hidden by what stands between, and that agrees with the fused points, in which
little is left of what moved. What stands on the ground in one piece takes it from the image that
shows most of it, where that does. No image, no colour.

Ref: A. Habib, E. Kim, C. Kim, "New methodologies for true orthophoto generation", PERS 73(1), 2007
(along a ray from below the camera, what is seen under a smaller angle than before is hidden).
"""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import MappingError
from recon.core.geometry.se3 import apply, invert
from recon.core.progress import tracked
from recon.core.values import PointCloud, RectifiedCamera
from recon.core.values.arrays import Bool, Float32, Float64, Int32, UInt8
from recon.core.values.camera import project
from recon.export.mesh.views import PosedImage, posed_images, sampled
from recon.export.occupancy import Flattening
from recon.export.product import ExportContext, ExportResult
from recon.export.rasters import RasterFigures, columns_of, ground_blocks, ground_heights, place_of
from recon.io.models.rasters import COLOUR_BANDS, RasterPlace, write_geotiff
from recon.map.fusion import fusion_range_m
from recon.map.ground.surface import WINDOW_M, GroundSurface

_BORDER: Final = 0.1  # fraction of the width of an image over which it counts less
# Pixels of an image as a fraction of those of the best one: that do for what stands in one piece,
# and that may be taken where something passed by in better ones: half and a quarter as fine.
_ENOUGH, _WORST = 1 / 4, 1 / 16
_SHARPNESS: Final = 8  # power of what images count, so that they blend where they are as good
_DARK: Final = 8  # below, exposures cannot be compared
_AROUND: Final = (5, 5)  # cells over which noise is averaged
_STRIDE: Final = 4  # of the cells whose pixels are looked at for the size of all
_ROWS: Final = 256  # of a raster at a time


def orthophoto_product(context: ExportContext, path: Path) -> ExportResult:
    """Write the map from above in the colours of its images, transparent where none sees it."""
    with TemporaryDirectory(prefix=".colours-", dir=path.parent) as folder:
        relief = Relief(context, Path(folder))
        for drive in context.drives:
            for frame in tracked(np.flatnonzero(drive.placed).tolist(), "visibility", "frames"):
                relief.look(relief.sight(drive.session.camera, drive.T_map_camera[frame]))
        place = place_of(context, context.gsd_m or relief.gsd_m)
        painted = Canvas(relief, place)
        for view in posed_images(context.drives):
            painted.add(view)
        with write_geotiff(path, place, bands=COLOUR_BANDS, crs=context.crs) as file:
            for row in range(0, place.rows, _ROWS):
                file.write(row, 0, painted.block(row, row + _ROWS))
    size = {"orthophoto_size": (place.columns, place.rows)}
    return ExportResult(RasterFigures(size, place.cell_m))


class Sight(NamedTuple):
    """What an image has of the cells around its camera."""

    at: tuple[slice, slice]
    pixels: Float32  # per m² seen from above; 0 = the cell is not seen
    u: Float64
    v: Float64


class Relief:
    """What is highest in each cell (R, C), north up, and how well the best image sees it.

    Its arrays lie in files of a folder, of which a tile or an image changes what is near.

    Attributes:
        height_m: float32, NaN = unknown.
        rgb: float32 (R, C, 3), colours of the fused points; NaN = none.
        piece: int32, what stands on the ground in one piece; 0 = the ground.
        pixels: float32, of the best image, per m²; 0 = none sees the cell.
        shown: float64 (P,), how many pixels the image has of each piece that has most.
    """

    def __init__(self, context: ExportContext, folder: Path) -> None:
        self.folder, self.T_file_map = folder, context.T_survey_map
        config = context.placed.tiles.config
        self.place = place_of(context, config.fusion.voxel_m)
        cameras = [drive.session.camera for drive in context.drives]
        far_m = max(fusion_range_m(camera, config.fusion) for camera in cameras)
        self._radius = math.ceil(min(far_m, config.occupancy.max_range_m) / self.place.cell_m)
        shape = self.place.rows, self.place.columns
        self.height_m: Float32 = self.array("height", shape, np.float32, np.nan)
        self.rgb: Float32 = self.array("rgb", (*shape, 3), np.float32, np.nan)
        self.piece: Int32 = self.array("piece", shape, np.int32)
        self.pixels: Float32 = self.array("pixels", shape, np.float32)
        tiles, known, pieces = context.placed.tiles, dict(Flattening(context.placed).grounds()), 0
        for tile in tiles:
            pieces += self._add(tile.cloud, known.get(tiles.bounds(tile.key)), pieces)
        self.shown = np.zeros(pieces + 1)
        for row, column, (ground_m, shown) in ground_blocks(context, self.place, ground_heights):
            heights = self.height_m[row : row + len(shown), column : column + shown.shape[1]]
            bare = np.isnan(heights) & (shown > 0)
            heights[bare] = ground_m[bare]

    def _add(self, cloud: PointCloud, ground: GroundSurface | None, first: int) -> int:
        """Put the points of a tile where they are highest; return how many pieces stand there."""
        above_m = np.zeros(len(cloud))
        if ground is not None:
            above_m = cloud.xyz[:, 2] - ground.height_at(cloud.xyz[:, :2])
            low = ~(above_m > ground.camera_height_m)  # NaN is low
            cloud, above_m = cloud.select(low), above_m[low]
        if not len(cloud):
            return 0
        if cloud.rgb is None:
            raise MappingError("the points of the map have no colours")
        xyz = apply(self.T_file_map, cloud.xyz.astype(np.float64))
        at, total = columns_of(self.place, xyz, 1.0 if cloud.weight is None else cloud.weight)
        weight = np.maximum(total(1.0), 1e-12)
        stands = (total(above_m > WINDOW_M) > 0.5 * weight).astype(np.uint8)
        count, pieces = cv2.connectedComponents(stands, connectivity=8)
        height = _even(np.where(weight > 1e-12, total(xyz[:, 2]) / weight, np.nan))
        higher = ~np.isnan(height) & ~(self.height_m[at] >= height)
        rgb = np.dstack([total(band) / weight for band in cloud.rgb.T])
        rgb[weight <= 1e-12] = np.nan
        pieces[pieces > 0] += first
        for old, new in ((self.height_m, height), (self.rgb, rgb), (self.piece, pieces)):
            old[at][higher] = new[higher]
        return count - 1

    def array(self, name: str, shape: tuple[int, ...], kind: Any, fill: float = 0.0) -> Any:
        """Return a new array in a file, if there is room for it: it is written without errors."""
        if shutil.disk_usage(self.folder).free < np.prod(shape) * np.dtype(kind).itemsize:
            raise OSError("no space left on device")
        values = np.memmap(self.folder / name, kind, "w+", shape=shape)
        if fill != 0.0:
            values[:] = fill
        return values

    @property
    def gsd_m(self) -> float:
        """Median width of a pixel on the ground, in the images that see it best; two digits."""
        pixels, piece = (one[::_STRIDE, ::_STRIDE] for one in (self.pixels, self.piece))
        seen = pixels[(piece == 0) & (pixels > 0)]
        if not len(seen):
            raise MappingError("no image of the drive sees the ground of the map")
        return float(f"{np.median(seen) ** -0.5:.2g}")

    def look(self, sight: Sight) -> None:
        """Compare an image with those before."""
        np.maximum(self.pixels[sight.at], sight.pixels, out=self.pixels[sight.at])
        np.maximum(self.shown, self.of_pieces(sight), out=self.shown)

    def of_pieces(self, sight: Sight) -> Float64:
        """Return float64 (P,), how many pixels an image has of each piece, per cell."""
        piece, pixels = self.piece[sight.at].ravel(), sight.pixels.ravel()
        return np.asarray(np.bincount(piece, pixels, len(self.shown)), np.float64)

    def sight(self, camera: RectifiedCamera, T_map_camera: Float64) -> Sight:
        """Return what an image of a camera there has."""
        T_file_camera = self.T_file_map @ T_map_camera
        eye = T_file_camera[:3, 3]
        cell = np.ravel(self.place.cells_of(eye[None, :2]))
        low = np.clip(cell - self._radius, 0, self.height_m.shape)
        high = np.clip(cell + self._radius + 1, low, self.height_m.shape)
        at = (slice(low[0], high[0]), slice(low[1], high[1]))
        middles = self.place.centres(low[0], low[1], tuple(high - low))
        off = np.dstack([middles, self.height_m[at]]) - eye
        u, v, _ = project(off.reshape(-1, 3) @ T_file_camera[:3, :3], camera)
        u, v = u.reshape(off.shape[:2]), v.reshape(off.shape[:2])
        edge = np.minimum(np.minimum(u, camera.width_px - 1 - u), camera.height_px - 1 - v)
        fade = np.clip(np.minimum(edge, v) / (_BORDER * camera.width_px), 0, 1)
        away_m = np.linalg.norm(off, axis=2)
        # Per area of a level surface, which is seen under the sine of the depression.
        pixels = -fade * off[..., 2] * camera.focal_px**2 / away_m**3
        # What is NaN is not seen, either.
        off[..., 2] += np.where(self.piece[at] > 0, self.place.cell_m, 0)  # a roof hides no roof
        seen = (pixels > 0) & ~self._hidden(eye, cell, off)
        return Sight(at, np.where(seen, pixels, 0).astype(np.float32), u, v)

    def _hidden(self, eye: Float64, cell: NDArray[Any], off: Float64) -> Bool:
        """Return which cells, off an eye above a cell, lie lower than the sight over nearer ones.

        Of rays in all directions, the steepest rise up to each cell is kept.
        """
        turns, steps = int(2 * np.pi * self._radius), np.arange(1, self._radius + 1)
        angle = np.arange(turns) * (2 * np.pi / turns)
        row = np.rint(cell[0] - np.outer(np.sin(angle), steps)).astype(np.int32)
        column = np.rint(cell[1] + np.outer(np.cos(angle), steps)).astype(np.int32)
        rows, columns = self.height_m.shape
        nearer = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
        # Noise of the ground hides nothing, a crest does.
        screen = self.height_m[nearer] - np.where(self.piece[nearer] > 0, 0, self.place.cell_m)
        rise = np.fmax.accumulate((screen - eye[2]) / (steps * self.place.cell_m), axis=1)
        far_m = np.hypot(off[..., 0], off[..., 1])
        turn = np.rint(np.arctan2(off[..., 1], off[..., 0]) * (turns / (2 * np.pi))).astype(int)
        step = np.floor(far_m / self.place.cell_m).astype(int) - 2  # up to the cell before
        before = rise[turn % turns, np.clip(step, 0, self._radius - 1)]
        hidden = (step >= 0) & (off[..., 2] < before * far_m)
        return np.asarray(hidden | (step > self._radius - 3))  # or too far


def _even(height_m: Float64) -> Float64:
    """Return heights without noise and holes of a cell or two; edges stay."""
    known = ~np.isnan(height_m)
    middle_m = float(np.nanmedian(height_m))  # single precision is for what is left
    off_m = np.where(known, height_m - middle_m, 0).astype(np.float32)
    weight = cv2.blur(known.astype(np.float32), _AROUND)
    around = cv2.blur(off_m, _AROUND) / np.maximum(weight, 1e-6)
    filled = np.where(known, off_m, around).astype(np.float32)
    even = cv2.medianBlur(filled, _AROUND[0])
    even = np.where(np.abs(even - filled) < WINDOW_M, even, filled)  # a corner of what stands
    return np.where(known | (weight > 0.5), even + middle_m, np.nan)


class Canvas:
    """The picture while images are added."""

    def __init__(self, relief: Relief, place: RasterPlace) -> None:
        self._relief, cells, shape = relief, relief.place, (place.rows, place.columns)
        self._y_m = place.centres(0, 0, (place.rows, 1))[:, 0, 1]
        self._x_m = place.centres(0, 0, (1, place.columns))[0, :, 0]
        self._row = cells.north - 1 - np.floor(self._y_m / cells.cell_m).astype(int)
        self._column = np.floor(self._x_m / cells.cell_m).astype(int) - cells.west
        self._weight = relief.array("weight", shape, np.float32)
        self._rgb = relief.array("colours", (*shape, 3), np.uint8)

    def block(self, first: int, end: int) -> UInt8:
        """Return rows (4, rows, columns), transparent where no image sees the place."""
        opaque = np.where(self._weight[first:end] > 0, 255, 0).astype(np.uint8)
        return np.concatenate([self._rgb[first:end].transpose(2, 0, 1), opaque[None]])

    def add(self, view: PosedImage) -> None:
        """Put in the colours of an image where it is the best one so far."""
        relief, image = self._relief, view.image
        sight = relief.sight(view.camera, view.T_map_camera)
        ratio = sight.pixels / np.maximum(relief.pixels[sight.at], 1e-12)
        good, piece = ratio > _WORST, relief.piece[sight.at]
        gain, agreed = _compared(image, sight, relief.rgb[sight.at], good)
        shown = relief.of_pieces(sight) / np.maximum(relief.shown, 1e-12)
        ratio = np.where(piece > 0, shown[piece] * np.minimum(ratio / _ENOUGH, 1), ratio)
        weight = np.maximum(ratio * agreed, 1e-6)
        # The places of the picture in these cells.
        (top, end), (left, right) = (
            np.searchsorted(cells, (part.start, part.stop))
            for cells, part in zip((self._row, self._column), sight.at, strict=True)
        )
        i, j = self._row[top:end] - sight.at[0].start, self._column[left:right] - sight.at[1].start
        row, column = np.nonzero(good[i[:, None], j])
        cell, row, column = (i[row], j[column]), row + top, column + left
        xyz = np.column_stack([self._x_m[column], self._y_m[row], relief.height_m[sight.at][cell]])
        u, v, _ = project(apply(invert(relief.T_file_map @ view.T_map_camera), xyz), view.camera)
        rgb = sampled(image, u, v) * gain
        old, new = self._weight[row, column], weight[cell]
        share = new**_SHARPNESS / (new**_SHARPNESS + old.astype(np.float64) ** _SHARPNESS)
        share = np.where(piece[cell] > 0, new > old, share)[:, None]  # in one piece, no blend
        mixed = share * rgb + (1 - share) * self._rgb[row, column]
        self._rgb[row, column] = np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
        self._weight[row, column] = np.maximum(old, new)


def _compared(image: UInt8, sight: Sight, fused: Float32, good: Bool) -> tuple[Float64, Float32]:
    """Return what makes an image as bright as the fused points (3,), and how it agrees (R, C)."""
    known, off = good & ~np.isnan(fused[..., 0]), np.zeros(good.shape, np.float32)
    rgb, points = sampled(image, sight.u[known], sight.v[known]), fused[known]
    light = rgb.min(axis=1, initial=255) > _DARK
    gain = np.median(points[light] / rgb[light], axis=0) if light.any() else np.ones(3)
    off[known] = np.abs(gain * rgb - points).mean(axis=1)
    usual = 3 * max(float(np.median(off[known])), 1.0) if known.any() else 1.0
    around = cv2.blur(off, _AROUND) / np.maximum(cv2.blur(known.astype(np.float32), _AROUND), 1e-6)
    return gain, np.exp(-0.5 * (around / usual) ** 2)
