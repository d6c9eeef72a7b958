"""The rays of a drive, frame by frame, in one append-only file.

The format is private to this project. Every frame has a checksum, as the file of a killed run may
end anywhere; a resumed run truncates it to the size in its checkpoint and continues.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.values import RayCloud, RayGrain
from recon.io.files import reading

_MAGIC: Final = b"recon rays 1\n\0\0\0"
_HEADER: Final = struct.Struct("<16s3d")
_FRAME: Final = struct.Struct("<2I")
_RAY_BYTES: Final = 10
_FARTHEST_M: Final = 1e5


class RayWriter:
    """Appends frames to a file.

    Args:
        path: The file, in an existing folder.
        grain: Grain of the rays.
        size: Bytes to keep of an existing file; None = start a new one.

    Raises:
        FormatError: The file is shorter than ``size``.
    """

    def __init__(self, path: Path, grain: RayGrain, size: int | None = None) -> None:
        if size is not None and (not path.is_file() or path.stat().st_size < size):
            raise FormatError("rays of the unfinished run are missing", where=path)
        self._file: IO[bytes] = path.open("wb" if size is None else "r+b")
        if size is None:
            header = _HEADER.pack(_MAGIC, grain.cell_m, grain.unit_m, grain.max_range_m)
            self._file.write(header)
        else:
            self._file.truncate(size)
            self._file.seek(size)

    def append(self, rays: RayCloud) -> None:
        """Write the next frame."""
        arrays = (
            rays.places.astype("<i2", copy=False),
            rays.sigma_m.astype("<f2", copy=False),
            rays.confidence,
            rays.count,
        )
        content = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
        self._file.write(_FRAME.pack(len(rays), zlib.crc32(content)))
        self._file.write(content)

    def sync(self) -> int:
        """Flush everything to disk and return the size in bytes."""
        self._file.flush()
        os.fsync(self._file.fileno())
        return self._file.tell()

    def close(self) -> None:
        """Flush and close the file."""
        self.sync()
        self._file.close()


class RayFile:
    """The frames of a ray file.

    Args:
        path: A file written by `RayWriter`.

    Raises:
        FormatError: The file is missing or not a ray file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with reading(path), path.open("rb") as file:
            header = file.read(_HEADER.size)
        if len(header) != _HEADER.size or not header.startswith(_MAGIC):
            raise FormatError("not a ray file of a run", where=path)
        self.grain = RayGrain(*_HEADER.unpack(header)[1:])
        sizes_m = (self.grain.cell_m, self.grain.unit_m, self.grain.max_range_m)
        # Not above the range; this is false for NaN as well.
        if not (min(sizes_m) > 0 and max(sizes_m) <= self.grain.max_range_m <= _FARTHEST_M):
            raise FormatError("sizes of the rays are impossible", where=path, got=sizes_m)

    def __len__(self) -> int:
        """Return the number of frames.

        Raises:
            FormatError: The file is truncated.
        """
        frames = 0
        with reading(self._path), self._path.open("rb") as file:
            file.seek(_HEADER.size)
            while (head := self._head(file)) is not None:
                file.seek(head[0] * _RAY_BYTES, os.SEEK_CUR)
                frames += 1
        return frames

    def __iter__(self) -> Iterator[RayCloud]:
        """Yield one frame after the other.

        Raises:
            FormatError: The file is truncated or damaged.
        """
        with reading(self._path), self._path.open("rb") as file:
            file.seek(_HEADER.size)
            while (head := self._head(file)) is not None:
                count, checksum = head
                content = file.read(count * _RAY_BYTES)
                if zlib.crc32(content) != checksum:
                    raise self._damaged()
                yield _unpack(content, count, self.grain.unit_m)

    def _head(self, file: IO[bytes]) -> tuple[int, int] | None:
        """Return the number of rays and checksum of the frame that starts here; None at the end."""
        head = file.read(_FRAME.size)
        if not head:
            return None
        if len(head) != _FRAME.size:
            raise self._damaged()
        count, checksum = _FRAME.unpack(head)
        if count * _RAY_BYTES > self._path.stat().st_size - file.tell():
            raise self._damaged()
        return int(count), int(checksum)

    def _damaged(self) -> FormatError:
        return FormatError("the rays are truncated or damaged", where=self._path)


def _unpack(content: bytes, count: int, unit_m: float) -> RayCloud:
    places, sigma, rest = np.split(np.frombuffer(content, np.uint8), [6 * count, 8 * count])
    return RayCloud(
        places=places.view("<i2").astype(np.int16, copy=False).reshape(-1, 3),
        sigma_m=sigma.view("<f2").astype(np.float16, copy=False),
        confidence=rest[:count],
        count=rest[count:],
        unit_m=unit_m,
    )
