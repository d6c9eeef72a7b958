"""Map axes (x forward, y left, z up), and the ground plane below the first frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field, field_validator

from recon.core.errors import MappingError
from recon.core.geometry.se3 import exp_so3, make_transform, transform_cloud
from recon.core.settings import Settings
from recon.core.values import PointCloud
from recon.core.values.arrays import Float64, freeze
from recon.sources.source import Mount

AXES_MAP_WORLD: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""The turn from camera-like axes (right, down, forward) to map axes (forward, left, up)."""
UP_MAP: Final = np.array([0.0, 0.0, 1.0])
_UP_CAMERA: Final = np.array([0.0, -1.0, 0.0])
_MAX_TILT_DEG: Final = 30.0  # planes tilted more than this are no ground
_MIN_TILT_DEG: Final = 3.0
"""The map is levelled only where the camera is tilted more than this: less is within the error of
the measured ground, and of a road's own slope."""
# Lengths are those on a road: they are times the scale of the scene.
_MAX_RANGE_M: Final = 20.0
"""How far away the ground is looked for: farther points are too uncertain to level by."""
_INLIER_M: Final = 0.05  # distance to the plane of points that support it
_MOST_POINTS: Final = 20_000
_MIN_INLIERS: Final = 500  # points that must support the plane, after thinning
_TRIALS: Final = 300  # random planes that are tried
_Part = Annotated[float, Field(ge=-1e6, le=1e6)]  # of a direction


class AxesSettings(Settings):
    """Where the map has its origin, and what is up in it."""

    origin: Literal["camera", "ground"] = "camera"
    """Origin of the map: the first left camera, or the ground below it, so that z = 0 is on the
    ground at the start."""
    up: tuple[_Part, _Part, _Part] | None = None
    """What is up in the axes of the first left camera (right, down, forward), such as `[0, 0, -1]`
    where it looks straight down; none = as inertial unit, robot or surfaces show."""

    @field_validator("up")
    @classmethod
    def _check_up(cls, up: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if up is not None and math.hypot(*up) < 1e-6:
            raise ValueError("up must be a direction, and is zero")
        return up


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """The ground below a camera, in its axes: the points with ``normal · xyz = -height_m``.

    ``normal``, float64 (3,), has unit length and points up; ``inliers`` points support it.
    """

    normal: Float64
    height_m: float
    inliers: int = 0

    def __post_init__(self) -> None:
        freeze(self, "normal", np.float64, (3,))

    @property
    def tilt_deg(self) -> float:
        """Angle between the camera's own up (-y) and the normal."""
        return math.degrees(math.acos(min(1.0, max(-1.0, float(self.normal @ _UP_CAMERA)))))


def map_axes(
    ground: GroundPlane | None,
    settings: AxesSettings,
    camera_height_m: float | None = None,
    up: Float64 | None = None,
    R_base_world: Float64 | None = None,
) -> Float64:
    """Return ``T_map_world``, float64 (4, 4), from world to map axes.

    Without a ground below the first camera (None), or with a tilt below the limit, exactly x_map =
    z_world, y_map = -x_world, z_map = -y_world; else also turned the short way so that the ground's
    normal is z_map, or ``up`` (3,), world axes, where that is known. Where the axes of the robot
    are known, ``R_base_world`` (3, 3), the map has those, turned by ``up`` alone. With its origin
    on the ground, also moved up along z, by ``camera_height_m`` or else by the height above the
    plane.
    """
    turn = AXES_MAP_WORLD if R_base_world is None else R_base_world
    free = up is None and R_base_world is None
    if free and ground is not None and ground.tilt_deg > _MIN_TILT_DEG:
        up = ground.normal
    if up is not None:
        turn = short_turn(turn @ up, UP_MAP) @ turn
    height_m = 0.0
    if settings.origin == "ground" and camera_height_m is not None:
        height_m = camera_height_m
    elif settings.origin == "ground":
        if ground is None:
            what = "the first frame shows no ground to put the map's origin on"
            hint = "start where it is seen, set ground.camera_height_m, or use axes.origin=camera"
            raise MappingError(what, hint=hint)
        height_m = ground.height_m / float(turn[2] @ ground.normal)
    return make_transform(turn, np.array([0.0, 0.0, height_m]))


def short_turn(first: Float64, second: Float64) -> Float64:
    """Return the smallest rotation (3, 3) that takes one direction to another."""
    axis = np.cross(first, second)
    angle = math.acos(min(1.0, max(-1.0, float(first @ second))))
    size = float(np.linalg.norm(axis))
    if size == 0.0:  # the same, or opposite: then about any axis across
        return exp_so3(angle * np.roll(second, 1))
    return exp_so3(axis / size * angle)


def base_axes(
    T_map_world: Float64, camera_height_m: float | None, mount: Mount | None = None
) -> Float64:
    """Return ``T_base_camera``, from the left camera to the base of the vehicle (`base_link`).

    Without a ``mount``, the base has the axes of the map in the first frame (x forward, y left, z
    up), and its origin on the ground below the camera; in the camera where its height is not known.
    """
    if mount is not None:
        return mount.T_base_camera
    return make_transform(T_map_world[:3, :3], np.array([0.0, 0.0, camera_height_m or 0.0]))


def estimate_ground(
    cloud: PointCloud, scale: float = 1.0, up: Float64 | None = None
) -> GroundPlane | None:
    """Find the plane that the camera stands above in a cloud of one frame, camera axes.

    RANSAC, then least squares: the plane within 30 degrees of level with the most support, or None.
    The same cloud gives the same plane. ``up`` (3,) is upwards, camera axes; None = their own.

    Ref: M. Fischler and R. Bolles, "Random sample consensus", CACM 24, 1981.
    """
    if up is not None:
        turn = make_transform(short_turn(up, _UP_CAMERA), np.zeros(3))
        plane = estimate_ground(transform_cloud(cloud, turn, frame="camera"), scale)
        return None if plane is None else replace(plane, normal=plane.normal @ turn[:3, :3])
    xyz, inlier_m = cloud.xyz.astype(np.float64), scale * _INLIER_M
    # Points in range that a tilted ground could hold, thinned evenly.
    z, highest = xyz[:, 2], xyz[:, 2] * math.tan(math.radians(_MAX_TILT_DEG))
    xyz = xyz[(z > 0) & (z < scale * _MAX_RANGE_M) & (xyz[:, 1] > -highest)]
    xyz = xyz[:: max(1, math.ceil(len(xyz) / _MOST_POINTS))]
    if len(xyz) < _MIN_INLIERS:
        return None
    normal, height = _best_plane(xyz, inlier_m)
    for _ in range(3):
        inside = np.abs(xyz @ normal + height) < inlier_m
        if inside.sum() < _MIN_INLIERS:
            return None
        # The plane nearest to the points in the least-squares sense; its normal points up.
        centre = xyz[inside].mean(axis=0)
        _, vectors = np.linalg.eigh(np.cov((xyz[inside] - centre).T))
        normal = vectors[:, 0] * (-1.0 if vectors[1, 0] > 0 else 1.0)
        height = float(-normal @ centre)
    plane = GroundPlane(normal, height, int(inside.sum()))
    return plane if plane.tilt_deg <= _MAX_TILT_DEG and height > 0 else None


def _best_plane(xyz: Float64, inlier_m: float) -> tuple[Float64, float]:
    """Return the plane through three points that most points support."""
    random = np.random.default_rng(0)
    few = xyz[:: max(1, len(xyz) // 4000)]
    triples = few[random.integers(0, len(few), (_TRIALS, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals = normals / np.where(length > 0, length, 1.0)[:, None]
    normals *= np.where(normals[:, 1] > 0, -1.0, 1.0)[:, None]
    heights = -np.einsum("ij,ij->i", normals, triples[:, 0])
    level = normals @ _UP_CAMERA >= math.cos(math.radians(_MAX_TILT_DEG))
    support = np.abs(few @ normals.T + heights) < inlier_m
    votes = np.where(level & (heights > 0), support.sum(axis=0), -1)
    best = int(np.argmax(votes))
    return normals[best], float(heights[best])
