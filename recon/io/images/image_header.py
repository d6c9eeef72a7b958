"""The size of an image from its header, before anything is decoded."""

from __future__ import annotations

from io import BytesIO
from typing import Final

from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.PpmImagePlugin import PpmImageFile
from PIL.TiffImagePlugin import ImageFileDirectory_v2

_READERS: Final[dict[bytes, type[ImageFile]]] = {
    b"\x89PNG": PngImageFile,
    b"\xff\xd8": JpegImageFile,
    b"BM": BmpImageFile,
    b"P": PpmImageFile,
}

_TIFF: Final = (b"II*\0", b"MM\0*")
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257


def image_size(content: bytes) -> tuple[int, int] | None:
    """Return the width and height that the header of an image states; None if it states none.

    The readers of Pillow are called directly: `PIL.Image.open` has a limit of its own.
    """
    reader = next((kind for start, kind in _READERS.items() if content.startswith(start)), None)
    try:
        if content.startswith(_TIFF):
            width, height = _tiff_size(content)
        elif reader is not None:
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
