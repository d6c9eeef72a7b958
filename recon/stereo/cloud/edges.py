"""Removal of flying edges: pixels floating between a foreground and its background."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from recon.core.values import Disparity, Reason
from recon.core.values.arrays import Float32, UInt8

_RADIUS_PX: Final = 2
"""Half width of the window."""

_MAX_GRADIENT: Final = 1.0
"""Largest disparity gradient of a matchable surface, pixels per pixel."""

_TOLERANCE_PX: Final = 0.5
"""Matching noise allowed on top of the gradient."""

_MIN_SUPPORT: Final = 0.36
"""Share of the window that must lie on the surface of its centre."""


def remove_flying_edges(disparity: Disparity) -> Disparity:
    """Drop pixels that too few of their neighbours could share a surface with.

    Depth noise grows with distance, disparity noise does not, so disparities are tested. A
    surface that both cameras see changes by less than one pixel per pixel (the disparity
    gradient limit); a neighbour within that cone supports the centre. At a clean step
    each side keeps half of its window, at a convex corner a third, while the mixed pixels on the
    ramp between the sides keep little more than their own column. Pixels without a disparity
    support none; the image is mirrored at its border.

    Returns:
        The disparity without those pixels; their reason is `Reason.EDGE`.

    Ref: Burt & Julesz, "A disparity gradient limit for binocular fusion", Science 208 (1980).
    """
    needed = _MIN_SUPPORT * (2 * _RADIUS_PX + 1) ** 2
    return disparity.reject(_support(disparity.values) < needed, Reason.EDGE)


def _support(values: Float32) -> UInt8:
    """Return uint8 (H, W), how many pixels of each window support its centre, with itself."""
    r = _RADIUS_PX
    height, width = values.shape
    padded = cv2.copyMakeBorder(values, r, r, r, r, cv2.BORDER_REFLECT_101)
    count = np.zeros(padded.shape, dtype=np.uint8)
    # Support is mutual, so each pair of pixels is compared once, over half of the window.
    for dy, dx in _half_window(r):
        limit = _TOLERANCE_PX + _MAX_GRADIENT * float(np.hypot(dy, dx))
        ahead = (slice(dy, None), slice(max(dx, 0), min(dx, 0) or None))
        here = (slice(None, -dy or None), slice(max(-dx, 0), min(-dx, 0) or None))
        near = cv2.compare(cv2.absdiff(padded[here], padded[ahead]), limit, cv2.CMP_LE) & 1
        cv2.add(count[here], near, dst=count[here])
        cv2.add(count[ahead], near, dst=count[ahead])
    return np.asarray(count[r : r + height, r : r + width] + np.uint8(1))


def _half_window(radius_px: int) -> list[tuple[int, int]]:
    """Return offsets (dy, dx) of one half of a window; the other half is its negative."""
    r = range(-radius_px, radius_px + 1)
    return [(dy, dx) for dy in r for dx in r if dy > 0 or (dy == 0 and dx > 0)]
