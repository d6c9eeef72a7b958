"""Images: PNG, JPEG, PGM, PPM, BMP and TIFF, messages of ROS; what is damaged is rejected."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from threading import Lock
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError, OutputError, ShapeError
from recon.core.text import counted
from recon.core.values.arrays import UInt8
from recon.io.atomic import write_bytes
from recon.io.files import SMALL_FILE_BYTES, StrPath, read_bytes, reader, reading
from recon.io.images.image_header import check_image_bytes, is_tiff, stated_size

FULL_WHITE: Final = 65535
MAX_MEGAPIXELS: Final = 100.0  # larger images are refused, unless more is asked for
_PIXEL_BYTES: Final = 16  # more than a pixel takes in any file
_LOG_LEVEL_LOCK: Final = Lock()
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
    "yuv422": (2, 8, cv2.COLOR_YUV2RGB_UYVY), "uyvy": (2, 8, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, 8, cv2.COLOR_YUV2RGB_YUY2), "yuyv": (2, 8, cv2.COLOR_YUV2RGB_YUY2),
}  # fmt: skip


def read_image(
    path: StrPath, white: int = FULL_WHITE, max_megapixels: float = MAX_MEGAPIXELS
) -> UInt8:
    """Read PNG, JPEG, PGM, PPM, BMP or TIFF: uint8 (H, W) if it is grey, else (H, W, 3) RGB.

    16 bits are scaled to 8, linearly: ``white``, the same for all images of a drive (`find_white`),
    becomes 255. An alpha channel is dropped. The EXIF orientation is ignored: a calibration refers
    to the pixels as the sensor recorded them.

    Raises:
        FormatError: The file is missing, empty, truncated, not an image, has more than
            ``max_megapixels`` (10⁶ pixels), or floating-point pixels.
    """
    return eight_bits(read_levels(path, max_megapixels), white)


def eight_bits(levels: NDArray[Any], white: int = FULL_WHITE) -> UInt8:
    """Scale 16 bits to 8, rounded; brighter values than ``white`` are 255."""
    if levels.dtype == np.uint8:
        return levels
    scaled = (levels.astype(np.uint32) * 255 + white // 2) // white
    return np.minimum(scaled, 255).astype(np.uint8)


def find_white(images: Iterable[NDArray[Any]]) -> int:
    """Return the largest value of a sensor of 8 to 16 bits, 2^n - 1; values may be unscaled."""
    brightest = max((int(image.max()) for image in images if image.size), default=FULL_WHITE)
    return int(2 ** max(8, brightest.bit_length()) - 1)


@reader
def read_levels(path: StrPath, max_megapixels: float = MAX_MEGAPIXELS) -> NDArray[Any]:
    """Read an image as stored, such as a mask: uint8 or uint16, (H, W) or (H, W, 3) RGB."""
    content = read_bytes(path, int(max_megapixels * 1e6 * _PIXEL_BYTES) + SMALL_FILE_BYTES)
    return _decode(content, max_megapixels)


def decode_image(content: bytes, where: StrPath) -> UInt8:
    """Read an image like `read_image`, from bytes in memory."""
    with reading(where):
        return eight_bits(_decode(content, MAX_MEGAPIXELS))


def _decode(content: bytes, max_megapixels: float) -> NDArray[Any]:
    size = stated_size(content)
    # A small file can hold very many pixels.
    if size is not None and size[0] * size[1] > max_megapixels * 1e6:
        what, expected = "image has too many pixels", f"at most {max_megapixels:g} million"
        hint = "make it smaller; --set source.max_megapixels= allows more"
        raise FormatError(what, got=f"{size[0]}x{size[1]}", expected=expected, hint=hint)
    check_image_bytes(content)
    try:
        with silent_opencv() if is_tiff(content) else nullcontext():
            image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
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
    _check_writable(path, suffix, image)
    pixels = image if image.ndim == 2 else swap_red_and_blue(image)
    try:
        done, content = cv2.imencode(suffix, pixels)
    except cv2.error as error:
        raise OutputError("image cannot be encoded", where=path, got=error.err) from error
    if not done:
        raise OutputError("image cannot be encoded", where=path)
    write_bytes(path, content.tobytes())


@contextmanager
def silent_opencv() -> Iterator[None]:
    """Stop OpenCV from logging to standard error what we raise as an exception anyway."""
    log = cv2.utils.logging  # whose level all threads share
    with _LOG_LEVEL_LOCK:
        before = log.getLogLevel()
        log.setLogLevel(log.LOG_LEVEL_SILENT)
        try:
            yield
        finally:
            log.setLogLevel(before)


def swap_red_and_blue(image: NDArray[Any]) -> NDArray[Any]:
    """Convert between RGB and OpenCV's BGR, in either direction."""
    return np.ascontiguousarray(image[:, :, ::-1])


def _check_writable(path: StrPath, suffix: str, image: NDArray[Any]) -> None:
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


def pixels_of_ros_image(
    data: NDArray[np.uint8],
    encoding: str,
    shape: tuple[int, int],
    step: int,
    *,
    big_endian: bool = False,
    where: str = "",
) -> UInt8:
    """Decode the bytes (N,) of a ROS image message: uint8 (H, W) if it is grey, else (H, W, 3) RGB.

    Rows are ``step`` bytes long. 16-bit pixels are scaled over their full range to 8 bits.

    Ref: ``sensor_msgs/image_encodings.hpp``.
    """
    name = encoding.lower()
    if name not in _ENCODINGS:
        what, expected = "image encoding is not supported", ", ".join(sorted(_ENCODINGS))
        raise FormatError(what, where=where, got=encoding, expected=expected)
    height_px, width_px = shape
    channels, bits, to_rgb = _ENCODINGS[name]
    row = width_px * channels * bits // 8
    if step < row or data.size < step * (height_px - 1) + row or min(shape) < 1:
        got = f"{counted(data.size, 'byte')}, {step} per row"
        expected = f"{width_px}x{height_px} pixels of {name}"
        what = "image message has too few bytes"
        raise FormatError(what, where=where, got=got, expected=expected)
    rows = np.lib.stride_tricks.as_strided(data, (height_px, row), (step, 1))
    pixels = np.ascontiguousarray(rows)
    if bits == 16:
        wide = pixels.view(">u2" if big_endian else "<u2")
        return ((wide.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if channels > 1:
        pixels = pixels.reshape(height_px, width_px, channels)
    return pixels if to_rgb is None else np.asarray(cv2.cvtColor(pixels, to_rgb), dtype=np.uint8)
