"""Decodes ROS images: ``sensor_msgs/Image`` in its common encodings."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError
from recon.core.values.arrays import UInt8
from recon.core.words import counted

# Encoding: channels, bits per channel, and how OpenCV makes RGB of it, if it is not there already.
# OpenCV names a Bayer pattern from pixel (1, 1) on, ROS from pixel (0, 0) on.
_ENCODINGS: Final[dict[str, tuple[int, int, int | None]]] = {
    "mono8": (1, 8, None),
    "8uc1": (1, 8, None),
    "mono16": (1, 16, None),
    "16uc1": (1, 16, None),
    "rgb8": (3, 8, None),
    "bgr8": (3, 8, cv2.COLOR_BGR2RGB),
    "8uc3": (3, 8, cv2.COLOR_BGR2RGB),
    "rgba8": (4, 8, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, 8, cv2.COLOR_BGRA2RGB),
    "8uc4": (4, 8, cv2.COLOR_BGRA2RGB),
    "bayer_rggb8": (1, 8, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, 8, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, 8, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, 8, cv2.COLOR_BayerGB2RGB),
    "yuv422": (2, 8, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, 8, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, 8, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, 8, cv2.COLOR_YUV2RGB_YUY2),
}


def pixels_of_ros_image(
    data: NDArray[np.uint8],
    encoding: str,
    shape: tuple[int, int],
    step: int,
    *,
    big_endian: bool = False,
    where: str = "",
) -> UInt8:
    """Decode the bytes of an image message.

    16-bit pixels are scaled over their full range to 8 bits, as in image files.

    Args:
        data: uint8 (N,), all rows, each ``step`` bytes long.
        encoding: Name of the encoding in ROS.
        shape: Height and width.
        step: Bytes per row, including padding.
        big_endian: Whether 16-bit pixels are big-endian.
        where: Topic or message, for the error message.

    Returns:
        uint8 (H, W) if the encoding is grey, else (H, W, 3) RGB.

    Ref: ``sensor_msgs/image_encodings.hpp``.
    """
    name = encoding.lower()
    if name not in _ENCODINGS:
        raise FormatError(
            "image encoding is not supported",
            where=where,
            got=encoding,
            expected=", ".join(sorted(_ENCODINGS)),
        )
    height_px, width_px = shape
    channels, bits, to_rgb = _ENCODINGS[name]
    row = width_px * channels * bits // 8
    if step < row or data.size < step * (height_px - 1) + row or min(shape) < 1:
        raise FormatError(
            "image message has too few bytes",
            where=where,
            got=f"{counted(data.size, 'byte')}, {step} per row",
            expected=f"{width_px}x{height_px} pixels of {name}",
        )
    rows = np.lib.stride_tricks.as_strided(data, (height_px, row), (step, 1))
    pixels = np.ascontiguousarray(rows)
    if bits == 16:
        wide = pixels.view(">u2" if big_endian else "<u2")
        return ((wide.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if channels > 1:
        pixels = pixels.reshape(height_px, width_px, channels)
    return pixels if to_rgb is None else np.asarray(cv2.cvtColor(pixels, to_rgb), dtype=np.uint8)
