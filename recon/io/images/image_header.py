"""What the bytes of an image file say: damage, which decoders fill in silently; size; focal length.

Ref:
    PNG: ISO/IEC 15948, section 5 (chunks). JPEG: ITU-T T.81, annex B (markers).
    PGM and PPM: the netpbm manual. BMP: BITMAPINFOHEADER in the Windows GDI reference.
    EXIF: CIPA DC-008 (Exif 2.32), section 4.6.5; CIPA DCG-001 for the 35 mm equivalent.
"""

from __future__ import annotations

import math
import re
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from typing import Any, Final

from PIL import Image
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.PpmImagePlugin import PpmImageFile
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from recon.core.errors import FormatError
from recon.core.text import counted
from recon.io.files import StrPath, reading

_PNG_START: Final = b"\x89PNG\r\n\x1a\n"
_JPEG_START: Final = b"\xff\xd8\xff"
_TIFF_STARTS: Final = (b"II*\x00", b"MM\x00*")
_PNM_HEADER: Final = re.compile(
    rb"P([2356])(?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)\s"
)
_BMP_HEADER: Final = struct.Struct("<2xI4xI4xiiHHII")
_READERS: Final[dict[bytes, type[ImageFile]]] = {
    b"\x89PNG": PngImageFile, b"\xff\xd8": JpegImageFile, b"BM": BmpImageFile, b"P": PpmImageFile,
}  # fmt: skip
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
_EXIF_IFD: Final = 0x8769
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405
_SENSOR_RESOLUTION, _SENSOR_UNIT, _SENSOR_WIDTH_PX = 0xA20E, 0xA210, 0xA002
_MM_PER_UNIT: Final = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_DIAGONAL_35MM: Final = math.hypot(36.0, 24.0)


def check_image_bytes(content: bytes) -> None:
    """Check that the content is a complete image; of TIFF the decoder does, not this."""
    if content.startswith(_PNG_START):
        _check_png(content)
    elif content.startswith(_JPEG_START):
        _check_jpeg(content)
    elif content[:1] == b"P" and content[1:2] in b"2356":
        _check_pnm(content)
    elif content.startswith(b"BM"):
        _check_bmp(content)
    elif not is_tiff(content):
        raise FormatError("not an image", expected="PNG, JPEG, PGM, PPM, BMP or TIFF")


def is_tiff(content: bytes) -> bool:
    """Return whether the content starts like a TIFF."""
    return content.startswith(_TIFF_STARTS)


def _truncated(kind: str, got: str) -> FormatError:
    what = f"{kind} image is truncated or damaged"
    return FormatError(what, got=got, hint="copy the file again")


def _check_png(content: bytes) -> None:
    """Walk the chunks up to IEND; each must be complete and match its checksum."""
    at, name, size = len(_PNG_START), b"", counted(len(content), "byte")
    while name != b"IEND":
        if at + 12 > len(content):
            raise _truncated("PNG", f"the file ends after {size}, before IEND")
        length = int.from_bytes(content[at : at + 4], "big")
        name = content[at + 4 : at + 8]
        end = at + 8 + length
        if end + 4 > len(content):
            raise _truncated("PNG", f"the file ends inside a chunk of {counted(length, 'byte')}")
        if zlib.crc32(content[at + 4 : end]) != int.from_bytes(content[end : end + 4], "big"):
            raise _truncated("PNG", f"checksum of chunk {name!r} differs")
        at = end + 4


def _check_jpeg(content: bytes) -> None:
    """Look for the end marker after the start of scan; an embedded thumbnail has its own."""
    at = 2
    while content[at : at + 2] != b"\xff\xda":
        if at + 4 > len(content) or content[at] != 0xFF:
            raise _truncated("JPEG", "no start of scan")
        # A marker may be preceded by any number of fill bytes 0xFF.
        at += 1 if content[at + 1] == 0xFF else 2 + struct.unpack_from(">H", content, at + 2)[0]
    if content.rfind(b"\xff\xd9") < at:
        raise _truncated("JPEG", "no end-of-image marker")


def _check_pnm(content: bytes) -> None:
    header = _PNM_HEADER.match(content)
    if header is None:
        raise _truncated("PGM/PPM", "no readable header")
    kind, width, height, top = (int(group) for group in header.groups())
    samples = width * height * (3 if kind in {3, 6} else 1)
    if kind in {2, 3}:
        found = len(content[header.end() :].split())
    else:
        found = (len(content) - header.end()) // (2 if top > 255 else 1)
    if found < samples:
        raise _truncated("PGM/PPM", f"{found} of {counted(samples, 'sample')}")


def _check_bmp(content: bytes) -> None:
    """Compute the size from rows padded to four bytes, as a header may declare a size of 0."""
    if len(content) < _BMP_HEADER.size:
        size = counted(len(content), "byte")
        raise _truncated("BMP", f"the file ends after {size}, in its header")
    header = _BMP_HEADER.unpack_from(content)
    _, offset, width, height, _, bits, compression, stored = header
    rows = (width * bits + 31) // 32 * 4 * abs(height)
    run_lengths = compression in {1, 2}
    needed = offset + (stored if run_lengths else rows)
    if len(content) < needed:
        raise _truncated("BMP", f"{len(content)} of {counted(needed, 'byte')}")


@contextmanager
def _silent_pillow() -> Iterator[None]:
    """Leave unsaid what Pillow warns of in damaged headers: their check says it in a line."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def stated_size(content: bytes) -> tuple[int, int] | None:
    """Return the width and height that a header states; None = a damaged or unknown one."""
    reader = next((kind for start, kind in _READERS.items() if content.startswith(start)), None)
    try:
        with _silent_pillow():
            if is_tiff(content):
                width, height = _tiff_size(content)
            elif reader is not None:  # `PIL.Image.open` has a limit of its own
                width, height = reader(BytesIO(content)).size
            else:
                return None
    except Exception:  # noqa: BLE001 - a damaged header, which the check of the content reports
        return None
    return int(width), int(height)


def _tiff_size(content: bytes) -> tuple[int, int]:
    """Read the first directory alone: Pillow's reader knows fewer kinds of pixels than ours."""
    directory, stream = ImageFileDirectory_v2(content[:8]), BytesIO(content)
    stream.seek(directory.next)
    directory.load(stream)
    return directory[_TIFF_WIDTH], directory[_TIFF_HEIGHT]


@dataclass(frozen=True)
class ExifFocal:
    """A focal length in pixels of the image, and what the camera recorded for it."""

    focal_px: float
    basis: str


def read_focal_length(path: StrPath, width_px: int, height_px: int) -> ExifFocal | None:
    """Read the focal length of a photograph by its sensor or 35 mm equivalent; None = unknown."""
    try:
        with _silent_pillow(), reading(path), Image.open(path) as image:
            tags: Mapping[int, Any] = image.getexif().get_ifd(_EXIF_IFD)
            return _by_sensor(tags, width_px) or _by_35mm(tags, width_px, height_px)
    except FormatError:
        return None


def _by_sensor(tags: Mapping[int, Any], width_px: int) -> ExifFocal | None:
    focal_mm = _number(tags.get(_FOCAL_LENGTH))
    resolution = _number(tags.get(_SENSOR_RESOLUTION))
    unit_mm = _MM_PER_UNIT.get(tags.get(_SENSOR_UNIT, 2))
    recorded_px = _number(tags.get(_SENSOR_WIDTH_PX))
    if focal_mm is None or resolution is None or unit_mm is None or recorded_px is None:
        return None
    focal_px = focal_mm * resolution / unit_mm * width_px / recorded_px
    return ExifFocal(focal_px, f"{focal_mm:g} mm and the pixels of the sensor")


def _by_35mm(tags: Mapping[int, Any], width_px: int, height_px: int) -> ExifFocal | None:
    equivalent_mm = _number(tags.get(_FOCAL_LENGTH_35MM))
    if equivalent_mm is None:
        return None
    focal_px = equivalent_mm * math.hypot(width_px, height_px) / _DIAGONAL_35MM
    return ExifFocal(focal_px, f"{equivalent_mm:g} mm as 35 mm equivalent")


def _number(value: Any) -> float | None:
    """Return a positive finite number, or None; EXIF writes 0 or a fraction over 0 for unknown."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None
