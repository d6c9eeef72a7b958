"""A rendered pair with a known disparity, which a network has to find before it is believed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from recon.core.errors import MatchingError
from recon.core.values.arrays import Float32, UInt8

_SIZE: Final = (384, 256)  # where the network leaves it free
_NEAREST: Final = 0.05  # disparity of the pixel that is nearest, of the width
_GRAINS_PX: Final = (0.8, 2.5, 8.0)  # blur of the noise that the texture is the sum of
# Of a textured plane even a network that matches at a quarter of the size finds its disparity to a
# fraction of a pixel; a network that does not is fed or read in the wrong way.
_LIMIT_PX: Final = 1.0


def rendered_pair(size: tuple[int, int] = _SIZE) -> tuple[UInt8, UInt8, Float32]:
    """Return left and right view of a slanted, textured plane, and its disparity.

    uint8 (H, W) twice and float32 (H, W); 2 to 5 % of the width.
    """
    width, height = size
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    ratio = 0.4 + 0.4 * rows / height + 0.2 * columns / width
    disparity = (_NEAREST * width * ratio).astype(np.float32)
    margin = int(np.ceil(_NEAREST * width)) + 2
    random = np.random.default_rng(0)
    texture = np.zeros((height, width + margin))
    for grain in _GRAINS_PX:
        noise = cv2.GaussianBlur(random.normal(size=texture.shape), (0, 0), grain)
        texture += noise / noise.std()
    levels = np.clip(128 + 30 * texture, 0, 255).astype(np.float32)
    left = cv2.remap(levels, columns + margin - disparity, rows, cv2.INTER_CUBIC)
    left = np.clip(np.rint(left), 0, 255).astype(np.uint8)
    return left, np.rint(levels[:, margin:]).astype(np.uint8), disparity


def check_network(
    match: Callable[[UInt8, UInt8], Float32],
    size: tuple[int, int] | None,
    output_scale: float,
    path: Path,
) -> None:
    """Let a network match a rendered pair once.

    Raises:
        MatchingError: It does not find the disparity; the line says what it finds instead.
    """
    left, right, truth = rendered_pair(size or _SIZE)
    height, width = truth.shape
    # Not near the border, nor where the right view does not show the plane.
    inner = np.s_[height // 8 : -height // 8, int(2 * _NEAREST * width) : -width // 16]
    found, truth = match(left, right)[inner], truth[inner]
    if not np.isfinite(found).mean() > 0.5:
        raise _failure(path, "no finite number", "check mean and std, and the output")
    found, truth = (one[np.isfinite(found)] for one in (found, truth))
    error = float(np.median(np.abs(found - truth)))
    if error <= _LIMIT_PX:
        return
    if np.ptp(found) < 1e-3 * max(1e-6, float(np.abs(found).max())):
        raise _failure(path, f"{float(found[0]):.4g} everywhere", "check mean, std and output")
    ratio = float(np.median(found / truth))
    if ratio and float(np.median(np.abs(found / ratio - truth))) <= _LIMIT_PX:
        scale = f"--set matching.onnx.output_scale={output_scale / ratio:.4g}"
        raise _failure(path, f"{ratio:.4g} times the disparity", scale)
    what = f"a median error of {error:.3g} px"
    raise _failure(path, what, "check preset, mean, std, output, and which input is left")


def _failure(path: Path, got: str, hint: str) -> MatchingError:
    return MatchingError(
        "the network does not find the disparity of a rendered plane",
        where=path,
        got=got,
        hint=f"{hint} (self_test=false lets it pass)",
    )
