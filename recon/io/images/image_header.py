"""The size of an image from its header, before anything is decoded.

Ref:
    PNG: ISO/IEC 15948. JPEG: ITU-T T.81, annex B. TIFF 6.0, section 2. BMP: BITMAPINFOHEADER.
"""

from __future__ import annotations

import re
import struct
from typing import Final

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_PNM: Final = re.compile(rb"P[2356](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s")
#: JPEG's start-of-frame markers; C4, C8 and CC are other segments.
_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_TIFF_WIDTH: Final = 256
_TIFF_HEIGHT: Final = 257
_TIFF_SHORT: Final = 3


def image_size(content: bytes) -> tuple[int, int] | None:
    """Width and height that the header of an image file states; None if it states none."""
    try:
        return _stated_size(content)
    except struct.error:  # truncated, which the decoder reports
        return None


def _stated_size(content: bytes) -> tuple[int, int] | None:
    if content.startswith(_PNG):
        width, height = struct.unpack_from(">II", content, 16)
        return width, height
    if content.startswith(b"\xff\xd8"):
        return _jpeg(content)
    if content.startswith(b"BM"):
        width, height = struct.unpack_from("<ii", content, 18)
        return abs(width), abs(height)
    if content[:4] in (b"II*\0", b"MM\0*"):
        return _tiff(content)
    header = _PNM.match(content)
    return None if header is None else (int(header[1]), int(header[2]))


def _jpeg(content: bytes) -> tuple[int, int] | None:
    """Walk the segments to the start of the frame."""
    at = 2
    while at + 4 <= len(content) and content[at] == 0xFF:
        marker, length = content[at + 1], struct.unpack_from(">H", content, at + 2)[0]
        if marker in _FRAMES:
            height, width = struct.unpack_from(">HH", content, at + 5)
            return width, height
        # Any number of fill bytes may precede a marker.
        at += 1 if marker == 0xFF else 2 + length
    return None


def _tiff(content: bytes) -> tuple[int, int] | None:
    """Read the entries of the first directory."""
    order = "<" if content[:1] == b"I" else ">"
    start = struct.unpack_from(order + "I", content, 4)[0]
    found: dict[int, int] = {}
    for entry in range(struct.unpack_from(order + "H", content, start)[0]):
        tag, kind = struct.unpack_from(order + "HH", content, start + 2 + 12 * entry)
        number = order + ("H" if kind == _TIFF_SHORT else "I")
        found[tag] = struct.unpack_from(number, content, start + 10 + 12 * entry)[0]
    if _TIFF_WIDTH not in found or _TIFF_HEIGHT not in found:
        return None
    return found[_TIFF_WIDTH], found[_TIFF_HEIGHT]
