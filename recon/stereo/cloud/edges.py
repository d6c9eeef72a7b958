"""Removal of flying edges: pixels floating between a foreground and its background."""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import Field

from recon.core.settings import Settings
from recon.core.values import Disparity, Reason
from recon.core.values.arrays import Float32, UInt8


class EdgeSettings(Settings):
    """Which pixels count as floating between two surfaces."""

    enabled: bool = Field(default=True, description="Whether flying edges are removed.")
    radius_px: int = Field(default=2, ge=1, le=5, description="Half width of the window.")
    max_gradient: float = Field(
        default=1.0,
        gt=0,
        le=10,
        description="Largest disparity gradient of a matchable surface, pixels per pixel.",
    )
    tolerance_px: float = Field(
        default=0.5, ge=0, le=10, description="Matching noise allowed on top of the gradient."
    )
    min_support: float = Field(
        default=0.36,
        ge=0,
        le=1,
        description="Share of the window that must lie on the surface of its centre.",
    )


def remove_flying_edges(disparity: Disparity, settings: EdgeSettings) -> Disparity:
    """Drop pixels that too few of their neighbours could share a surface with.

    Depth noise grows with distance, disparity noise does not, so disparities are tested. A
    surface that both cameras see changes by less than ``max_gradient`` pixels per pixel (the
    disparity gradient limit); a neighbour within that cone supports the centre. At a clean step
    each side keeps half of its window, at a convex corner a third, while the mixed pixels on the
    ramp between the sides keep little more than their own column. Pixels without a disparity
    support none; the image is mirrored at its border.

    Args:
        disparity: The disparity from a matcher.
        settings: The window and its limits.

    Returns:
        The disparity without those pixels; their reason is `Reason.EDGE`.

    Ref: Burt & Julesz, "A disparity gradient limit for binocular fusion", Science 208 (1980).
    """
    if not settings.enabled:
        return disparity
    needed = settings.min_support * (2 * settings.radius_px + 1) ** 2
    return disparity.reject(_support(disparity.values, settings) < needed, Reason.EDGE)


def _support(values: Float32, settings: EdgeSettings) -> UInt8:
    """uint8 (H, W): number of pixels in each window that support its centre, itself included."""
    r = settings.radius_px
    height, width = values.shape
    padded = cv2.copyMakeBorder(values, r, r, r, r, cv2.BORDER_REFLECT_101)
    count = np.zeros(padded.shape, dtype=np.uint8)
    # Support is mutual, so each pair of pixels is compared once, over half of the window.
    for dy, dx in _half_window(r):
        limit = settings.tolerance_px + settings.max_gradient * float(np.hypot(dy, dx))
        ahead = (slice(dy, None), slice(max(dx, 0), min(dx, 0) or None))
        here = (slice(None, -dy or None), slice(max(-dx, 0), min(-dx, 0) or None))
        near = cv2.compare(cv2.absdiff(padded[here], padded[ahead]), limit, cv2.CMP_LE) & 1
        cv2.add(count[here], near, dst=count[here])
        cv2.add(count[ahead], near, dst=count[ahead])
    return np.asarray(count[r : r + height, r : r + width] + np.uint8(1))


def _half_window(radius_px: int) -> list[tuple[int, int]]:
    """Offsets (dy, dx) of one half of a window; the other half is its negative."""
    r = range(-radius_px, radius_px + 1)
    return [(dy, dx) for dy in r for dx in r if dy > 0 or (dy == 0 and dx > 0)]
