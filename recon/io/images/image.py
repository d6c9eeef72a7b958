"""Images: PNG, JPEG, PGM, PPM, BMP and TIFF, messages of ROS; what is damaged is rejected.

Ref:
    PNG: ISO/IEC 15948, 5 (chunks). JPEG: ITU-T T.81, annex B (markers). PGM, PPM: netpbm manual.
    BMP: BITMAPINFOHEADER, Windows GDI. EXIF: CIPA DC-008, 4.6.5; DCG-001 (35 mm equivalent).
"""

from __future__ import annotations

import math
import re
import struct
import warnings
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from io import BytesIO
from pathlib import Path
from threading import Lock
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.PpmImagePlugin import PpmImageFile
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from recon.core.errors import FormatError, OutputError, ShapeError
from recon.core.text import counted
from recon.core.values.arrays import UInt8
from recon.io.atomic import write_bytes
from recon.io.files import SMALL_FILE_BYTES, StrPath, read_bytes, reader, reading

MAX_MEGAPIXELS: Final = 100.0  # larger images are refused, unless more is asked for
_PIXEL_BYTES: Final = 16  # more than a pixel takes in any file
_SILENT: Final = Lock()  # for what all threads share: the log level, the filter of warnings
_GREY_ONLY: Final = frozenset({".pgm"})
_COLOUR_ONLY: Final = frozenset({".ppm"})
_EIGHT_BIT_ONLY: Final = frozenset({".jpg", ".jpeg"})
_WRITABLE: Final = _GREY_ONLY | _COLOUR_ONLY | _EIGHT_BIT_ONLY | {".png", ".tif", ".tiff"}
# Encoding: channels, bits per channel, and how OpenCV makes RGB of it, if it is not there already.
# OpenCV names a Bayer pattern from pixel (1, 1) on, ROS from pixel (0, 0) on.
_ENCODINGS: Final[dict[str, tuple[int, int, int | None]]] = {
    "mono8": (1, 8, None), "8uc1": (1, 8, None), "mono16": (1, 16, None), "16uc1": (1, 16, None),
    "rgb8": (3, 8, None), "bgr8": (3, 8, cv2.COLOR_BGR2RGB), "8uc3": (3, 8, cv2.COLOR_BGR2RGB),
    "rgba8": (4, 8, cv2.COLOR_RGBA2RGB), "bgra8": (4, 8, cv2.COLOR_BGRA2RGB),
    "8uc4": (4, 8, cv2.COLOR_BGRA2RGB),
    "bayer_rggb8": (1, 8, cv2.COLOR_BayerBG2RGB), "bayer_bggr8": (1, 8, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, 8, cv2.COLOR_BayerGR2RGB), "bayer_grbg8": (1, 8, cv2.COLOR_BayerGB2RGB),
    "bayer_rggb16": (1, 16, cv2.COLOR_BayerBG2RGB), "bayer_bggr16": (1, 16, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg16": (1, 16, cv2.COLOR_BayerGR2RGB), "bayer_grbg16": (1, 16, cv2.COLOR_BayerGB2RGB),
    "rgb16": (3, 16, None), "bgr16": (3, 16, cv2.COLOR_BGR2RGB),
    "yuv422": (2, 8, cv2.COLOR_YUV2RGB_UYVY), "uyvy": (2, 8, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, 8, cv2.COLOR_YUV2RGB_YUY2), "yuyv": (2, 8, cv2.COLOR_YUV2RGB_YUY2),
    "nv12": (1, 8, cv2.COLOR_YUV2RGB_NV12), "nv21": (1, 8, cv2.COLOR_YUV2RGB_NV21),
}  # fmt: skip
_PLANES: Final = frozenset({"nv12", "nv21"})  # rows of colours of 2x2 pixels follow those of grey
_OUTLIERS: Final = 1e-3  # fraction of pixels at either end that need not be told apart
_ROOM: Final = 1 / 8  # around what a sample has, for images that are not in it


class Levels(NamedTuple):
    """Which 16-bit values become black and white."""

    black: int
    white: int


def read_image(
    path: StrPath, white: int | None = None, max_megapixels: float = MAX_MEGAPIXELS
) -> UInt8:
    """Read PNG, JPEG, PGM, PPM, BMP or TIFF: uint8 (H, W) if it is grey, else (H, W, 3) RGB.

    16 bits are scaled to 8: ``white`` becomes 255, None = by what the image has (`find_levels`).
    Alpha is dropped; the EXIF orientation is ignored: pixels are as the sensor recorded them.

    Raises:
        FormatError: The file is missing, truncated, not an image, has more than ``max_megapixels``
            (10⁶ pixels), or floating-point pixels.
    """
    values = read_levels(path, max_megapixels)
    return eight_bits(values, find_levels([values]) if white is None else Levels(0, white))


def eight_bits(values: NDArray[Any], levels: Levels) -> UInt8:
    """Scale 16 bits to 8, rounded; what is darker than black is 0, brighter than white 255."""
    if values.dtype == np.uint8:
        return values
    black, span = levels.black, levels.white - levels.black
    above = np.clip(np.arange(1 << 16) - black, 0, span)
    scaled: UInt8 = ((above * 255 + span // 2) // span).astype(np.uint8)[values]
    return scaled


def find_levels(images: Iterable[NDArray[Any]]) -> Levels:
    """Return the levels for images of a sensor: all that it can give, by the brightest value.

    Where nearly all pixels take less than a quarter of that, as in thermal images and at night,
    they are what these take, but no finer than what the sensor tells apart.
    """
    counts = np.zeros(1 << 16, np.int64)
    for image in images:
        counts += np.bincount(image.ravel(), minlength=counts.size)
    white = 2 ** max(8, int(np.flatnonzero(counts).max(initial=0)).bit_length()) - 1
    below = np.cumsum(counts)
    low, high = np.searchsorted(below, below[-1] * np.array([_OUTLIERS, 1 - _OUTLIERS])).tolist()
    if high - low >= white / 4:
        return Levels(0, white)
    span = max(255, round((high - low) * (1 + 2 * _ROOM)))
    black = min(max(0, (low + high - span) // 2), white - span)
    return Levels(black, black + span)


@reader
def read_levels(
    path: StrPath, max_megapixels: float = MAX_MEGAPIXELS, *, turned: bool = False
) -> NDArray[Any]:
    """Read uint8 or uint16, (H, W) or (H, W, 3) RGB, as stored, or ``turned`` as EXIF data say."""
    content = read_bytes(path, int(max_megapixels * 1e6 * _PIXEL_BYTES) + SMALL_FILE_BYTES)
    return _decode(content, max_megapixels, turned=turned)


def decode_levels(content: bytes, encoding: str, where: StrPath) -> NDArray[Any]:
    """Read an image like `read_levels`, from memory; colours are made of a Bayer pattern."""
    with reading(where):
        values, name = _decode(content, MAX_MEGAPIXELS), encoding.lower()
    code = _ENCODINGS[name][2] if name.startswith("bayer_") and name in _ENCODINGS else None
    return values if code is None or values.ndim > 2 else np.asarray(cv2.cvtColor(values, code))


def _decode(content: bytes, max_megapixels: float, *, turned: bool = False) -> NDArray[Any]:
    size = stated_size(content)
    # A small file can hold very many pixels.
    if size is not None and size[0] * size[1] > max_megapixels * 1e6:
        what, expected = "image has too many pixels", f"at most {max_megapixels:g} million"
        hint = "make it smaller; --set source.max_megapixels= allows more"
        raise FormatError(what, got=f"{size[0]}x{size[1]}", expected=expected, hint=hint)
    check_image_bytes(content)
    try:
        with silent_opencv() if content.startswith(_TIFF_STARTS) else nullcontext():
            how = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR if turned else cv2.IMREAD_UNCHANGED
            image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), how)
    except cv2.error as error:
        raise FormatError("image cannot be decoded", got=error.err) from error
    if image is None:
        raise FormatError("image cannot be decoded", hint="copy the file again")
    if image.dtype not in (np.uint8, np.uint16):
        got, what = image.dtype.name, "pixel type of the image is not supported"
        raise FormatError(what, got=got, expected="8 or 16 bits")
    return image if image.ndim == 2 else swap_red_and_blue(image[:, :, :3])


def read_grey_levels(path: StrPath) -> NDArray[Any]:
    """Read an image like `read_levels`, but always (H, W); three equal channels count as grey."""
    levels = read_levels(path)
    if levels.ndim == 2:
        return levels
    if (levels != levels[:, :, :1]).any():
        raise FormatError("image is in colour", where=path, expected="grey")
    return np.ascontiguousarray(levels[:, :, 0])


def write_image(path: StrPath, image: NDArray[Any]) -> None:
    """Write uint8 or uint16, (H, W) or RGB (H, W, 3), atomically, in the format of the suffix."""
    suffix = Path(path).suffix.lower()
    got = f"{image.dtype.name} {image.shape}"
    grey, colour = image.ndim == 2, image.ndim == 3 and image.shape[2] == 3
    if image.dtype not in (np.uint8, np.uint16) or not (grey or colour) or image.size == 0:
        expected = "uint8 or uint16 (H, W) or (H, W, 3)"
        raise ShapeError("array is not an image", got=got, expected=expected)
    if suffix not in _WRITABLE:
        what, expected = "unknown image format", ", ".join(sorted(_WRITABLE))
        raise OutputError(what, where=path, got=suffix or "no suffix", expected=expected)
    if (
        (suffix in _GREY_ONLY and colour)
        or (suffix in _COLOUR_ONLY and grey)
        or (suffix in _EIGHT_BIT_ONLY and image.dtype != np.uint8)
    ):
        what = f"a {suffix} file cannot hold this image"
        raise OutputError(what, where=path, got=got, hint="write .png")
    write_bytes(path, encode_image(image, suffix, path))


def encode_image(image: NDArray[Any], suffix: str, where: StrPath) -> bytes:
    """Return the bytes of an image file of a format; ``where`` names it in errors."""
    pixels = image if image.ndim == 2 else swap_red_and_blue(image)
    try:
        done, content = cv2.imencode(suffix, pixels)
    except cv2.error as error:
        raise OutputError("image cannot be encoded", where=where, got=error.err) from error
    if not done:
        raise OutputError("image cannot be encoded", where=where)
    return bytes(content.tobytes())


@contextmanager
def silent_opencv() -> Iterator[None]:
    """Stop OpenCV from logging to standard error what we raise as an exception anyway."""
    log = cv2.utils.logging
    with _SILENT:
        before = log.getLogLevel()
        log.setLogLevel(log.LOG_LEVEL_SILENT)
        try:
            yield
        finally:
            log.setLogLevel(before)


def swap_red_and_blue(image: NDArray[Any]) -> NDArray[Any]:
    """Convert between RGB and OpenCV's BGR, in either direction."""
    return np.ascontiguousarray(image[:, :, ::-1])


def pixels_of_ros_image(
    data: NDArray[np.uint8],
    encoding: str,
    shape: tuple[int, int],
    step: int,
    *,
    big_endian: bool = False,
    where: str = "",
) -> NDArray[Any]:
    """Decode the bytes (N,) of a ROS image message, whose rows are ``step`` bytes long.

    Returns uint8 or uint16, (H, W) if it is grey, else (H, W, 3) RGB.

    Ref: ``sensor_msgs/image_encodings.hpp``.
    """
    name = encoding.lower()
    if name not in _ENCODINGS:
        what, expected = "image encoding is not supported", ", ".join(sorted(_ENCODINGS))
        raise FormatError(what, where=where, got=encoding, expected=expected)
    height_px, width_px = shape
    channels, bits, to_rgb = _ENCODINGS[name]
    row, rows, odd = width_px * channels * bits // 8, height_px, False
    if name in _PLANES:
        rows, odd = height_px * 3 // 2, bool(height_px % 2 or width_px % 2)
        step = row if data.size == rows * row else step  # some count bytes of both planes
    if odd or step < row or data.size < step * (rows - 1) + row or min(shape) < 1:
        got = f"{counted(data.size, 'byte')}, {step} per row"
        expected = f"{width_px}x{height_px} pixels of {name}"
        what = "image has an odd size" if odd else "image message has too few bytes"
        raise FormatError(what, where=where, got=got, expected=expected)
    pixels = np.ascontiguousarray(np.lib.stride_tricks.as_strided(data, (rows, row), (step, 1)))
    if bits == 16:
        pixels = pixels.view(">u2" if big_endian else "<u2").astype(np.uint16)
    if channels > 1:
        pixels = pixels.reshape(height_px, width_px, channels)
    return pixels if to_rgb is None else np.asarray(cv2.cvtColor(pixels, to_rgb))


_PNG_START, _JPEG_START = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
_TIFF_STARTS: Final = (b"II*\x00", b"MM\x00*")
_PNM_HEADER: Final = re.compile(
    rb"P([2356])(?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)\s"
)
_BMP_HEADER: Final = struct.Struct("<2xI4xI4xiiHHII")
_READERS: Final[dict[bytes, type[ImageFile]]] = {
    b"\x89PNG": PngImageFile, b"\xff\xd8": JpegImageFile, b"BM": BmpImageFile, b"P": PpmImageFile,
}  # fmt: skip
_TIFF_WIDTH, _TIFF_HEIGHT, _EXIF_IFD = 256, 257, 0x8769
_ORIENTATION: Final = 0x0112
_SENSOR_UNIT: Final = 0xA210
#: Focal length, its 35 mm equivalent, pixels of the sensor per unit, width of the recorded image.
_EXIF_NUMBERS: Final = (0x920A, 0xA405, 0xA20E, 0xA002)
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
    elif not content.startswith(_TIFF_STARTS):
        raise FormatError("not an image", expected="PNG, JPEG, PGM, PPM, BMP or TIFF")


def _truncated(kind: str, got: str) -> FormatError:
    what = f"{kind} image is truncated or damaged"
    return FormatError(what, got=got, hint="copy the file again")


def _check_png(content: bytes) -> None:
    # Each chunk up to IEND must be complete and match its checksum.
    at, name = len(_PNG_START), b""
    while name != b"IEND":
        if at + 12 > len(content):
            size = counted(len(content), "byte")
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
    # The end marker comes after the start of scan; an embedded thumbnail has its own.
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
    # Rows are padded to four bytes; a header may declare a size of 0.
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


def stated_size(content: bytes) -> tuple[int, int] | None:
    """Return the width and height that a header states; None = a damaged or unknown one."""
    reader = next((kind for start, kind in _READERS.items() if content.startswith(start)), None)
    try:
        with _silent_pillow():
            if content.startswith(_TIFF_STARTS):  # Pillow's reader knows fewer kinds of pixels
                directory, stream = ImageFileDirectory_v2(content[:8]), BytesIO(content)
                stream.seek(directory.next)
                directory.load(stream)
                width, height = directory[_TIFF_WIDTH], directory[_TIFF_HEIGHT]
            elif reader is not None:  # `PIL.Image.open` has a limit of its own
                width, height = reader(BytesIO(content)).size
            else:
                return None
    except Exception:  # noqa: BLE001 - a damaged header, which the check of the content reports
        return None
    return int(width), int(height)


@contextmanager
def _silent_pillow() -> Iterator[None]:
    """Leave unsaid what Pillow warns of in damaged headers: their check says it in a line."""
    with _SILENT, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


class ExifFocal(NamedTuple):
    """A focal length in pixels of the image, and what the camera recorded for it."""

    focal_px: float
    basis: str


def read_focal_length(path: StrPath, width_px: int, height_px: int) -> ExifFocal | None:
    """Read the focal length of a photograph by its sensor or 35 mm equivalent; None = unknown."""
    try:
        with _silent_pillow(), reading(path), Image.open(path) as image:
            tags: Mapping[int, Any] = image.getexif().get_ifd(_EXIF_IFD)
            unit_mm = _MM_PER_UNIT.get(tags.get(_SENSOR_UNIT, 2))
            focal_mm, equivalent_mm, resolution, recorded_px = (
                _number(tags.get(name)) for name in _EXIF_NUMBERS
            )
    except FormatError:
        return None
    if focal_mm and resolution and unit_mm and recorded_px:
        focal_px = focal_mm * resolution / unit_mm * width_px / recorded_px
        return ExifFocal(focal_px, f"{focal_mm:g} mm and the pixels of the sensor")
    if equivalent_mm:
        focal_px = equivalent_mm * math.hypot(width_px, height_px) / _DIAGONAL_35MM
        return ExifFocal(focal_px, f"{equivalent_mm:g} mm as 35 mm equivalent")
    return None


def read_orientation(path: StrPath) -> int:
    """Return the EXIF orientation of a JPEG, 1 to 8; 1 = as stored, also where none is known."""
    try:
        with reading(path), Path(path).open("rb") as file:
            if file.read(len(_JPEG_START)) != _JPEG_START:
                return 1
            with _silent_pillow(), Image.open(file, formats=("JPEG",)) as image:
                found = image.getexif().get(_ORIENTATION, 1)
    except FormatError:
        return 1
    return found if found in range(1, 9) else 1


def _number(value: Any) -> float | None:
    """Return a positive finite number, or None; EXIF writes 0 or a fraction over 0 for unknown."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None
