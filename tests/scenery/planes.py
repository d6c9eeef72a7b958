"""Textured planes with exact disparity: the simplest scenes to test a stage on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from recon.core.values import DisparityTruth, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Bool, Float64, UInt8
from recon.core.values.camera import disparity_from_depth
from recon.street.kernels.surface import fractal_noise
from recon.street.render import View, stereo_views

_CONTRAST_DN = 90.0
_OCTAVES = 6
_GAIN = 0.9


@dataclass(frozen=True)
class Plane:
    """A plane ``normal · xyz = offset_m`` in left camera axes, or its part (x0, x1, y0, y1)."""

    normal: tuple[float, float, float]
    offset_m: float
    window_m: tuple[float, float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class PlanePair:
    """A grey pair with its ground truth; NaN where the left image sees no plane."""

    pair: RectifiedPair
    truth: DisparityTruth


def fronto_parallel_pair(camera: RectifiedCamera, depth_m: float, *, seed: int = 0) -> PlanePair:
    """A fronto-parallel textured wall: constant disparity."""
    return plane_pair(camera, [Plane((0.0, 0.0, 1.0), depth_m)], seed)


def slanted_pair(
    camera: RectifiedCamera, depth_m: float, slope: tuple[float, float], *, seed: int = 0
) -> PlanePair:
    """A textured plane ``Z = depth_m + slope_x·X + slope_y·Y``: disparity is linear in u and v."""
    return plane_pair(camera, [Plane((-slope[0], -slope[1], 1.0), depth_m)], seed)


def step_pair(
    camera: RectifiedCamera, near_m: float, far_m: float, half_width_px: float, *, seed: int = 0
) -> PlanePair:
    """A square in the centre of the left image in front of a wall, with an occluded strip."""
    half = half_width_px * near_m / camera.focal_px
    x = ((camera.width_px - 1) / 2 - camera.cx_px) * near_m / camera.focal_px
    y = ((camera.height_px - 1) / 2 - camera.cy_px) * near_m / camera.focal_px
    square = Plane((0.0, 0.0, 1.0), near_m, (x - half, x + half, y - half, y + half))
    return plane_pair(camera, [square, Plane((0.0, 0.0, 1.0), far_m)], seed)


def plane_pair(camera: RectifiedCamera, planes: Sequence[Plane], seed: int) -> PlanePair:
    """Render planes; the nearest occludes the others."""
    left, right = stereo_views(camera, np.eye(4))
    depth, nearest = _first_plane(planes, left.origin, left.directions(left.pixels()))
    size = (camera.height_px, camera.width_px)
    # Coarsest lattice spacing of 16 pixels in the left image, at any depth.
    spacing_m = 16.0 * float(np.nanmedian(depth)) / camera.focal_px
    images = [_image(view, planes, spacing_m, seed) for view in (left, right)]
    truth = DisparityTruth(
        disparity_from_depth(depth, camera).reshape(size),
        _seen_by(right, planes, left, depth, nearest).reshape(size),
    )
    return PlanePair(RectifiedPair(images[0], images[1], camera), truth)


def _image(view: View, planes: Sequence[Plane], spacing_m: float, seed: int) -> UInt8:
    rays = view.directions(view.pixels())
    depth, nearest = _first_plane(planes, view.origin, rays)
    known = np.isfinite(depth)
    grey = np.full(len(rays), 127.5)
    xyz = view.origin + depth[known, None] * rays[known]
    # Offset each plane along the third axis of the noise, so that each has its own texture.
    xyz[:, 2] += 1000.0 * nearest[known]
    width, spacing = depth[known] / view.focal_px, np.full(len(xyz), spacing_m)
    grain = fractal_noise(xyz, np.zeros_like(xyz), width, spacing, _OCTAVES, _GAIN, seed)
    grey[known] += _CONTRAST_DN * grain
    levels = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return np.asarray(levels.reshape(view.height_px, view.width_px))


def _first_plane(
    planes: Sequence[Plane], origin: Float64, rays: Float64
) -> tuple[Float64, Float64]:
    """Depth (N,) of the nearest plane on each ray, NaN = none, and its index."""
    depths = np.stack([_plane_depth(plane, origin, rays) for plane in planes])
    nearest = depths.argmin(axis=0)
    depth = depths[nearest, np.arange(len(rays))]
    return np.where(np.isfinite(depth), depth, np.nan), nearest.astype(np.float64)


def _plane_depth(plane: Plane, origin: Float64, rays: Float64) -> Float64:
    """Depth (N,) along rays of unit depth; inf where they miss the plane."""
    normal = np.array(plane.normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (plane.offset_m - normal @ origin) / (rays @ normal)
        hit = np.isfinite(depth) & (depth > 0)
        if plane.window_m is not None:
            x, y = (origin[:2] + depth[:, None] * rays[:, :2]).T
            x0, x1, y0, y1 = plane.window_m
            hit &= (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
    return np.where(hit, depth, np.inf)


def _seen_by(
    right: View, planes: Sequence[Plane], left: View, depth: Float64, nearest: Float64
) -> Bool:
    """Whether the right camera sees the point of each left pixel."""
    known = np.flatnonzero(np.isfinite(depth))
    xyz = left.origin + depth[known, None] * left.directions(left.pixels()[known])
    reach = xyz - right.origin
    found = _first_plane(planes, right.origin, reach / reach[:, 2:])[1]
    seen = np.zeros(len(depth), dtype=np.bool_)
    seen[known] = (found == nearest[known]) & right.inside(right.project(xyz))
    return seen
