"""What is up in a drive: by the surfaces that all its frames saw.

Most of what stands on the ground is level or upright, so up is a direction to which many normals
are parallel, and the others perpendicular. Which of several it is, the camera says: most are held
upright, and are moved along the ground, not up a wall. Where these contradict each other, or parts
of a drive disagree, it is not known.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.values.arrays import Float64

LEVEL_DEG: Final = 8.0  # of level or upright, what a garden still is
_WITHIN: Final = math.radians(LEVEL_DEG)
_NEAR, _LOW = math.cos(_WITHIN), math.sin(_WITHIN)  # components along up
_DIRECTIONS: Final = 4000  # that are tried, 3° apart
_MOST_NORMALS: Final = 20_000
_LEAST_NORMALS: Final = 100  # of a part of the drive
_PARTS: Final = 8
_MOST_SIGMA_DEG: Final = 3.0
_SLOPE_DEG: Final = 1.0  # standard deviation of the slope of ground
_TILT: Final = 0.75  # nats for each unit of 1 - cos of the angle to the camera's own up
_DOUBTED: Final = math.cos(math.radians(50.0))  # tilted more, a camera may look at a wall
_TURNED: Final = 0.5  # length of the mean of the camera's own up, below which it says nothing
_CLIMBED: Final = 0.5  # part of the motion, squared, that is too much to be up a wall
_DENSER: Final = 1.75  # times as many normals lie near a direction that is that of something flat
_ACROSS: Final = 0.1  # of walls alone, that must stand across the others
_LEAST_RATIO: Final = 0.02  # of all normals, that are of more than a table
NOT_KNOWN: Final = "not known"
TOO_FEW: Final = "too few surfaces were seen"


@dataclass(frozen=True)
class Level:
    """By what a map is level, and how well: ``sigma_deg`` of what is up; NaN = not estimated."""

    by: str = "first frame"  # or setting, imu, robot, surfaces, or `NOT_KNOWN`
    sigma_deg: float = math.nan
    why: str = ""  # it is not known

    @property
    def text(self) -> str:
        if self.by == NOT_KNOWN:
            return "level not known"
        return "level " + (
            f"by {self.by}" if math.isnan(self.sigma_deg) else f"to {self.sigma_deg:.1f}°"
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know of a map that may not be level."""
        if self.by != NOT_KNOWN:
            return ()
        what = f"what is up is not known ({self.why}): the map is as level as its first camera, and"
        hint = "what is up in its axes (x right, y down, z forward)"
        return (f"{what} grid and costmap are wrong if that is not; --set axes.up=[…] says {hint}",)


def level_by_surfaces(normals: Float64, T_world_camera: Float64) -> tuple[Float64 | None, Level]:
    """Return what is up, float64 (3,), by normals (N, 3) of surfaces, as they were seen in time.

    ``T_world_camera``, float64 (F, 4, 4), is the path; both are in world axes. None = not known.
    """
    if len(normals) < _PARTS * _LEAST_NORMALS:
        return None, Level(NOT_KNOWN, why=TOO_FEW)
    normals = normals[:: math.ceil(len(normals) / _MOST_NORMALS)]
    held = -T_world_camera[:, :3, 1].mean(axis=0)
    tried = _directions()
    likely = _likelihood(normals[::4], tried) - _TILT * (np.linalg.norm(held) - tried @ held)
    up = _refined(normals, tried[int(np.argmax(likely))])
    apart = [_refined(part, up) for part in np.array_split(normals, _PARTS)]
    spread = np.degrees(np.sqrt(np.mean([1.0 - (one @ up) ** 2 for one in apart]) / _PARTS))
    sigma_deg = float(np.hypot(spread, _SLOPE_DEG))
    why = _doubt(normals, up, T_world_camera, held)
    if sigma_deg > _MOST_SIGMA_DEG:
        why = f"surfaces show it to {sigma_deg:.0f}° only"
    return (None, Level(NOT_KNOWN, why=why)) if why else (up, Level("surfaces", sigma_deg))


def _directions() -> Float64:
    """Return directions (N, 3) all around, evenly: Fibonacci's sphere."""
    k = np.arange(_DIRECTIONS) + 0.5
    z, turn = 1.0 - 2.0 * k / _DIRECTIONS, math.pi * (1.0 + math.sqrt(5.0)) * k
    return np.stack([np.sqrt(1.0 - z**2) * np.cos(turn), np.sqrt(1.0 - z**2) * np.sin(turn), z], 1)


def _likelihood(normals: Float64, ups: Float64) -> Float64:
    """Return by how much, in nats, normals facing up or sideways are no chance; (N,) of ``ups``."""
    parts = np.empty((2, len(ups)))
    for some in np.array_split(np.arange(len(ups)), 40):  # all at once are large
        cos = normals.astype(np.float32) @ ups[some].T.astype(np.float32)
        parts[:, some] = (cos > _NEAR).mean(axis=0), (abs(cos) < _LOW).mean(axis=0)
    parts = np.vstack([parts, 1.0 - parts.sum(axis=0)])
    level = (1.0 - _NEAR) / 2.0
    by_chance = np.array([[level], [_LOW], [1.0 - level - _LOW]])
    return np.asarray((parts * np.log(np.maximum(parts, 1e-9) / by_chance)).sum(axis=0))


def _refined(normals: Float64, up: Float64) -> Float64:
    """Return the direction near ``up`` to which normals are most parallel or perpendicular."""
    for _ in range(10):
        cos = np.abs(normals @ up)
        level, upright = normals[cos > _NEAR], normals[cos < _LOW]
        found = np.linalg.eigh(upright.T @ upright - level.T @ level)[1][:, 0]
        up = found * np.sign(found @ up)
    return up


def _doubt(normals: Float64, up: Float64, T_world_camera: Float64, held: Float64) -> str:
    """Return why a direction may not be up although surfaces look as if, or nothing."""
    cos = normals @ up
    floor, ceiling = _stands_out(1.0 - cos), _stands_out(1.0 + cos)
    walls = normals[np.abs(cos) < _LOW]
    alike = np.linalg.eigvalsh(walls.T @ walls)[1] < _ACROSS * len(walls)
    if not (floor or ceiling) and (alike or not _stands_out(np.abs(cos), math.sin)):
        return "surfaces are no more level or upright than anything else"
    steady = float(np.linalg.norm(held))
    upright = float(held @ up) / max(steady, 1e-9)  # cosine of the angle to the camera's own up
    if upright >= _DOUBTED or (steady < _TURNED and floor):
        return ""
    if upright <= -_DOUBTED:
        return "" if floor and not ceiling else "the camera seems upside down, and sees no ground"
    # Were the surface that seems to be the ground a wall, the camera would have climbed.
    climb = held - (held @ up) * up
    moved = np.diff(T_world_camera[:, :3, 3], axis=0)
    climbed = np.sum((moved @ climb) ** 2) / max(float(climb @ climb * np.sum(moved**2)), 1e-12)
    sure = floor and climbed > _CLIMBED
    return "" if sure else "the camera looks down at the ground, or at a wall"


def _stands_out(away: Float64, of: Callable[[float], float] = lambda a: 1.0 - math.cos(a)) -> bool:
    """Return whether normals are denser near a direction, or plane, than twice as far away.

    ``away`` (N,) grows evenly with the solid angle, which ``of`` gives of a distance in radians.
    """
    near, far = of(_WITHIN), of(2.0 * _WITHIN)
    inside, outside = float(np.mean(away < near)), float(np.mean((away >= near) & (away < far)))
    return inside > _LEAST_RATIO and inside * (far - near) > _DENSER * outside * near
