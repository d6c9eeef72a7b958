"""Rasters of the map from above as GeoTIFF (extra ``survey``), written part by part."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import OutputError, require
from recon.io.atomic import atomic_path
from recon.io.files import StrPath
from recon.io.models.las import check_crs

_EXTRA: Final = "survey"
_BLOCK_PX: Final = 256  # a multiple of 16, by the specification
_MOST_CELLS: Final = 4_000_000_000  # 6 by 6 km at 0.1 m


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
    path: StrPath, place: RasterPlace, *, colours: bool, crs: str | None
) -> Iterator[RasterFile]:
    """Open a GeoTIFF to be written: float32 with NaN where nothing is known, or colours with alpha.

    Only what is written takes room; the file appears when all is done. A raster that is too large
    is an `OutputError`.

    Ref: OGC 19-008r4, "OGC GeoTIFF Standard", 2019.
    """
    rasterio = require("rasterio", extra=_EXTRA)
    if place.columns * place.rows > _MOST_CELLS:
        got, expected = f"{place.columns} x {place.rows} cells", f"at most {_MOST_CELLS:g} cells"
        raise OutputError("the raster is too large", where=path, got=got, expected=expected)
    kind: dict[str, Any] = {"count": 1, "dtype": "float32", "nodata": float("nan")}
    if colours:
        kind = {"count": 4, "dtype": "uint8", "photometric": "RGB", "alpha": "yes"}
    west_m, north_m = place.west * place.cell_m, place.north * place.cell_m
    with atomic_path(path) as temporary:
        with rasterio.open(
            temporary, "w+", driver="GTiff", width=place.columns, height=place.rows,
            transform=rasterio.Affine(place.cell_m, 0, west_m, 0, -place.cell_m, north_m),
            crs=None if crs is None else check_crs(crs).to_wkt(), tiled=True, blockxsize=_BLOCK_PX,
            blockysize=_BLOCK_PX, compress="deflate", bigtiff="if_safer", sparse_ok=True, **kind,
        ) as dataset:  # fmt: skip
            yield RasterFile(dataset, rasterio.windows.Window, place)
            written = _checksums(dataset)
        # What is left is written when the file is closed, without an error if there is no room.
        whole = False
        with suppress(rasterio.errors.RasterioIOError), rasterio.open(temporary) as dataset:
            whole = _checksums(dataset) == written
        if not whole:
            raise OSError("parts of it are missing")


def _checksums(dataset: Any) -> list[int]:
    return [zlib.crc32(dataset.read(window=at).tobytes()) for _, at in dataset.block_windows(1)]
