"""A picture of a view in 3-D as it is at first, for paper and for pages without JavaScript."""

from __future__ import annotations

import base64
import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor

from recon.core.values.arrays import Float64, UInt8
from recon.report import style
from recon.report.scene import Json

_SIZE_PX: Final = np.array([1240.0, 700.0])  # columns, rows
_FIELD_RAD: Final = math.radians(45.0)  # plotly's field of view, from bottom to top
_STEPS: Final = 4000  # of which a path is drawn
_SQUARES_PX: Final = (2, 7)  # least and largest side of what stands for a point
_SURFACE: Final = {"color": "#b8c4ce"}  # of what has its colours by triangles


def draw_still(plot: Json) -> bytes:
    """Draw what a view shows at first as a PNG file, as large as fits, transparent around it.

    Points, and corners of triangles, are squares, the near ones larger and upon the far ones; paths
    are upon all.
    """
    scene = plot["layout"]["scene"]
    shown = [one for one in plot["data"] if one.get("visible") != "legendonly"]
    parts = [_in_view(one, scene) for one in sorted(shown, key=lambda one: "line" in one)]
    places = np.concatenate([part[0] for part in parts])
    low, extent = (places.min(axis=0), np.ptp(places, axis=0)) if len(places) else np.zeros((2, 2))
    zoom = float((_SIZE_PX / np.maximum(extent, 1.0)).min())
    columns, rows = (extent * zoom).astype(int) + _SQUARES_PX[1] + 1
    pixels = np.zeros((rows, columns, 4), np.uint8)
    for place, away, rgb in filter(lambda part: len(part[0]), parts):
        usual_px = math.sqrt(0.5 * rows * columns / len(rgb)) * np.median(away)
        sides = np.clip(usual_px / away, *_SQUARES_PX)
        within = [*np.ndindex(_SQUARES_PX[1], _SQUARES_PX[1])]
        covered = [np.flatnonzero(sides >= max(at) + 1) for at in within]
        # The near points come last, and of several values for a pixel the last one stays.
        point = np.concatenate(covered)
        order = np.argsort(point, kind="stable")
        column, row = (np.repeat(within, [*map(len, covered)], axis=0)[order]).T
        point = point[order]
        at_column, at_row = ((place - low) * zoom).astype(int)[point].T
        pixels[at_row + row, at_column + column, :3] = rgb[point]
        pixels[at_row + row, at_column + column, 3] = 255
    ranges = (np.ptp(scene[f"{axis}axis"]["range"]) for axis in "xyz")
    size, names = " by ".join(f"{side_m:.3g}" for side_m in ranges), (one["name"] for one in shown)
    seen = f"View in 3-D of {', '.join(names)}, in a box of {size} m (x forward, y left, z up)"
    return style.pack_png(Image.fromarray(pixels), {style.SEEN: seen})


def _in_view(trace: Json, scene: Json) -> tuple[Float64, Float64, UInt8]:
    """Return columns and rows (N, 2) of what is seen of a trace, how far away, and colours.

    The near come last.
    """
    xyz, rgb = _drawn(trace)
    box = np.array([scene[f"{axis}axis"]["range"] for axis in "xyz"])
    sides, eye, centre = (
        np.array([of[axis] for axis in "xyz"])
        for of in (scene["aspectratio"], scene["camera"]["eye"], scene["camera"]["center"])
    )
    ahead = (centre - eye) / np.linalg.norm(centre - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= max(float(np.linalg.norm(right)), 1e-9)
    rays = (xyz - box.mean(axis=1)) * sides / np.ptp(box, axis=1) - eye
    away, down = rays @ ahead, np.cross(ahead, right)
    focal_px = _SIZE_PX[1] / 2 / math.tan(_FIELD_RAD / 2)
    flat = np.stack([rays @ right, rays @ down], axis=1) / np.maximum(away, 1e-9)[:, None]
    place = _SIZE_PX / 2 + focal_px * flat
    seen = np.flatnonzero((away > 0) & (place >= 0).all(axis=1) & (place < _SIZE_PX).all(axis=1))
    order = seen[np.argsort(-away[seen], kind="stable")]
    return place[order], away[order], rgb[order]


def _drawn(trace: Json) -> tuple[Float64, UInt8]:
    """Return the places (N, 3) and colours (N, 3) by which a trace is drawn."""
    xyz = np.stack([_unpacked(trace[axis]) for axis in "xyz"], axis=1).astype(np.float64)
    look = trace.get("marker") or trace.get("line") or _SURFACE
    if "line" in trace and len(xyz):
        at = np.linspace(0, len(xyz) - 1, _STEPS)
        xyz = np.stack([np.interp(at, np.arange(len(xyz)), each) for each in xyz.T], axis=1)
    if isinstance(look["color"], str):
        return xyz, np.tile(np.array(ImageColor.getrgb(look["color"]), np.uint8), (len(xyz), 1))
    ends, named = zip(*look["colorscale"], strict=True)
    ratio = _unpacked(look["color"]) / max(look["cmax"], 1)
    bands = np.array([ImageColor.getrgb(name) for name in named]).T
    return xyz, np.stack([np.interp(ratio, ends, band) for band in bands], 1).astype(np.uint8)


def _unpacked(values: Any) -> NDArray[Any]:
    """Return values as plotly.js gets them as an array."""
    if isinstance(values, dict):
        return np.frombuffer(base64.b64decode(values["bdata"]), values["dtype"])
    return np.asarray(values)
