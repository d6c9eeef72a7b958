"""Maps from above: for Nav2 (ROS) an image and YAML, and as GeoTIFF (extra ``survey``).

Ref: https://docs.nav2.org/configuration/packages/configuring-map-server.html (mode ``trinary``: the
occupancy of a pixel is ``(255 - value) / 255``; the first row has the largest y; mode ``scale``:
pixels that are not opaque are unknown, others have costs from 0 to 100 between the thresholds).
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from recon.core.errors import FormatError, OutputError, require
from recon.core.text import counted
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from recon.core.values.arrays import UInt8
from recon.io.atomic import atomic_path, write_bytes, write_text
from recon.io.fields import read_yaml
from recon.io.files import StrPath, read_bytes, reader
from recon.io.images.image import encode_image
from recon.io.models.las import check_crs

_OCCUPIED_THRESH: Final = 0.65
# With the common 0.25, the grey level of unknown (205, occupancy 0.196…) would be read as free.
_FREE_THRESH: Final = 0.196
_GREY: Final = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}
_STRIP_ROWS: Final = 256
_KEYS: Final = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
_PGM_HEADER: Final = re.compile(rb"P5\s+(?:#[^\n]*\n\s*)*(\d+)\s+(\d+)\s+(\d+)\s")


def write_nav2(path: StrPath, grid: OccupancyGrid) -> tuple[Path, Path]:
    """Write ``path.pgm``, ``path.wld`` for a GIS and ``path.yaml``, each atomically."""
    image = Path(f"{Path(path)}.pgm")
    rows, columns = grid.cells.shape
    with atomic_path(image) as temporary, temporary.open("wb") as file:
        file.write(f"P5\n{columns} {rows}\n255\n".encode())
        for last in range(rows, 0, -_STRIP_ROWS):
            cells = grid.cells[max(0, last - _STRIP_ROWS) : last][::-1]
            grey = np.full(cells.shape, _GREY[UNKNOWN], np.uint8)
            for cell, value in _GREY.items():
                grey[cells == cell] = value
            file.write(grey.tobytes())
    return image, _describe(image, "trinary", grid, (_OCCUPIED_THRESH, _FREE_THRESH))


def write_nav2_costs(path: StrPath, grid: OccupancyGrid) -> tuple[Path, Path]:
    """Write cells from FREE to OCCUPIED as ``path.png``, ``.wld`` and ``.yaml``, each atomically.

    Cells below 0 are unknown: transparent, grey 205 if they are UNKNOWN, else 127.
    """
    image = Path(f"{Path(path)}.png")
    cells = grid.cells[::-1].astype(np.int16)
    # Two levels for a unit: Nav2 divides by 255, and rounds to units again.
    grey = np.where(cells < 0, np.where(cells == UNKNOWN, _GREY[UNKNOWN], 127), 255 - 2 * cells)
    alpha = np.where(cells < 0, 0, 255)
    # Channels are turned round on the way.
    pixels = np.dstack([alpha, grey, grey, grey]).astype(np.uint8)
    write_bytes(image, encode_image(pixels, ".png", image))
    # Just beside 0 and 100, as a cost at a threshold is not beyond it.
    return image, _describe(image, "scale", grid, (2 * OCCUPIED / 255 - 1e-6, 1e-6))


def _describe(image: Path, mode: str, grid: OccupancyGrid, thresholds: tuple[float, float]) -> Path:
    """Write YAML, which is returned, and ``.wld`` of an image with the cells of a grid."""
    # Size and turn of a pixel, and the centre of the first one: gdal.org, raster/wld.html.
    side_m, (x_m, y_m) = grid.resolution_m, grid.origin_m
    world = (side_m, 0, 0, -side_m, x_m + side_m / 2, y_m + (len(grid.cells) - 0.5) * side_m)
    # Without the rounding of a product: -64.6, where -646 · 0.1 is just below.
    text = "".join(f"{number:.12g}\n" for number in world)
    write_text(image.with_suffix(".wld"), text)
    described = {
        "image": image.name,
        "mode": mode,
        "resolution": float(f"{side_m:.12g}"),
        "origin": [float(f"{x_m:.12g}"), float(f"{y_m:.12g}"), 0.0],
        "negate": 0,
        "occupied_thresh": thresholds[0],
        "free_thresh": thresholds[1],
    }
    description = image.with_suffix(".yaml")
    write_text(description, yaml.safe_dump(described, sort_keys=False))
    return description


@reader
def read_grid(path: StrPath) -> OccupancyGrid:
    """Read a map, given by its YAML file, as Nav2 does in mode ``trinary``."""
    path = Path(path)
    fields = _fields(path)
    image = path.parent / str(fields["image"])
    grey = _read_pgm(image).astype(np.float64)
    occupancy = grey / 255 if fields["negate"] else (255 - grey) / 255
    cells = np.full(grey.shape, UNKNOWN, np.int8)
    cells[occupancy > float(fields["occupied_thresh"])] = OCCUPIED
    cells[occupancy < float(fields["free_thresh"])] = FREE
    x, y, _ = fields["origin"]
    return OccupancyGrid(
        np.ascontiguousarray(cells[::-1]), float(fields["resolution"]), (float(x), float(y))
    )


def _fields(path: Path) -> dict[str, Any]:
    """Read the YAML file; fields that are not numbers, and rotated maps, are rejected."""
    fields = read_yaml(path)
    missing = [key for key in _KEYS if key not in fields]
    if missing:
        raise FormatError(f"the map's YAML file has no {missing[0]!r}")
    mode, origin = fields.get("mode", "trinary"), fields["origin"]
    if mode != "trinary":
        raise FormatError("mode of the map is not supported", got=mode, expected="trinary")
    numbers = [fields[key] for key in ("resolution", "occupied_thresh", "free_thresh")]
    whole = isinstance(origin, list) and len(origin) == 3
    if not whole or not all(isinstance(n, (int, float)) for n in (*numbers, *origin)):
        raise FormatError("the map's YAML file holds a value that is not a number")
    if origin[2] != 0:
        raise FormatError("the map is rotated", got=f"yaw {origin[2]:g}", expected="0")
    return fields


@reader
def _read_pgm(path: Path) -> UInt8:
    content = read_bytes(path)
    header = _PGM_HEADER.match(content)
    if header is None or int(header[3]) != 255:
        raise FormatError("the map's image is not a binary 8-bit PGM")
    columns, rows = int(header[1]), int(header[2])
    body = content[header.end() :]
    if len(body) != rows * columns:
        what, got = "the map's image is truncated", counted(len(body), "byte")
        raise FormatError(what, got=got, expected=f"{rows * columns}")
    pixels: NDArray[np.uint8] = np.frombuffer(body, np.uint8)
    return pixels.reshape(rows, columns)


_EXTRA: Final = "survey"
_BLOCK_PX: Final = 256  # a multiple of 16, by the specification
_MOST_CELLS: Final = 4_000_000_000  # 6 by 6 km at 0.1 m
COLOUR_BANDS: Final = ("red", "green", "blue", "alpha")  # of uint8; others are float32


@dataclass(frozen=True)
class RasterPlace:
    """The cells of a raster: north is up, rows are counted from there."""

    cell_m: float  # edge of a cell
    west: int  # the first column, in cells from the origin
    north: int  # the end of the first row, in cells from the origin
    columns: int
    rows: int

    def cells_of(self, xy_m: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows and columns of points (N, 2), metres east and north."""
        column, row = np.floor(xy_m / self.cell_m).astype(np.int64).T
        return self.north - 1 - row, column - self.west

    def centres(self, row: int, column: int, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Return (rows, columns, 2): metres east and north of a block that begins at a cell."""
        rows, columns = np.indices(shape)
        east, north = column + columns + self.west + 0.5, self.north - row - rows - 0.5
        return np.stack([east, north], axis=-1) * self.cell_m


class RasterFile:
    """An open GeoTIFF."""

    def __init__(self, dataset: Any, window: Any, place: RasterPlace) -> None:
        self._dataset, self._window, self.place = dataset, window, place

    def read(self, row: int, column: int, shape: tuple[int, int]) -> NDArray[Any]:
        """Return a block (bands, rows, columns)."""
        window = self._window(column, row, shape[1], shape[0])
        return np.asarray(self._dataset.read(window=window))

    def write(self, row: int, column: int, block: NDArray[Any]) -> None:
        """Write a block (bands, rows, columns) that begins at a cell."""
        window = self._window(column, row, block.shape[2], block.shape[1])
        self._dataset.write(block, window=window)


@contextmanager
def write_geotiff(
    path: StrPath, place: RasterPlace, *, bands: Sequence[str], unit: str = "", crs: str | None
) -> Iterator[RasterFile]:
    """Open a GeoTIFF to be written: float32 with NaN where nothing is known, or `COLOUR_BANDS`.

    Bands have names, the first one a unit. Only what is written takes room; the file appears when
    all is done, in the cloud-optimised layout with overviews. A raster that is too large is an
    `OutputError`.

    Ref: OGC 21-026, "OGC Cloud Optimized GeoTIFF Standard", 2023.
    """
    rasterio = require("rasterio", extra=_EXTRA)
    copying = require("rasterio.shutil", extra=_EXTRA)
    if place.columns * place.rows > _MOST_CELLS:
        got, expected = f"{place.columns} x {place.rows} cells", f"at most {_MOST_CELLS:g} cells"
        raise OutputError("the raster is too large", where=path, got=got, expected=expected)
    coloured = bands == COLOUR_BANDS
    kind: dict[str, Any] = {"dtype": "float32", "nodata": float("nan")}
    if coloured:
        kind = {"dtype": "uint8", "photometric": "RGB", "alpha": "yes"}
    packed: dict[str, Any] = {"compress": "deflate", "bigtiff": "if_safer", "sparse_ok": True}
    west_m, north_m = place.west * place.cell_m, place.north * place.cell_m
    with (
        atomic_path(path) as temporary,
        TemporaryDirectory(prefix=".raster-", dir=temporary.parent) as folder,
    ):
        draft, final = Path(folder) / "draft.tif", Path(folder) / "final.tif"
        with rasterio.open(
            draft, "w+", driver="GTiff", width=place.columns, height=place.rows,
            transform=rasterio.Affine(place.cell_m, 0, west_m, 0, -place.cell_m, north_m),
            crs=None if crs is None else check_crs(crs).to_wkt(), tiled=True, blockxsize=_BLOCK_PX,
            blockysize=_BLOCK_PX, count=len(bands), **packed, **kind,
        ) as dataset:  # fmt: skip
            dataset.descriptions = bands
            dataset.set_band_unit(1, unit)
            yield RasterFile(dataset, rasterio.windows.Window, place)
            written = _checksums(dataset)
        # What is left is written when a file is closed, without an error if there is no room.
        whole, smaller = False, "average" if coloured else "nearest"  # a flag has no mean
        with suppress(rasterio.errors.RasterioError, rasterio._err.CPLE_BaseError):
            copying.copy(
                draft, final, driver="COG", blocksize=_BLOCK_PX, overview_resampling=smaller,
                **packed,
            )  # fmt: skip
            with rasterio.open(final) as dataset:
                whole = _checksums(dataset) == written
        if not whole:
            raise OSError("parts of it are missing")
        final.replace(temporary)


def _checksums(dataset: Any) -> list[int]:
    return [zlib.crc32(dataset.read(window=at).tobytes()) for _, at in dataset.block_windows(1)]
