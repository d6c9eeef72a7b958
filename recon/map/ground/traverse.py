"""Where a robot can drive: steps and slopes of the ground, each against its own uncertainty.

Neighbouring cells are measured by the same images, which matching blurs: far from the camera, a
step looks like a ramp, and a ditch is shallow. So each is judged twice: as it is measured, and as
large as it could be if all that rises within the blur were one step. An obstacle is what is over
the limit as measured. The cost of everything else is how probably it could be over the limit; where
that is more probable than not, or could not have been seen, nothing is known.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np
from pydantic import Field
from scipy.special import ndtr

from recon.core.geometry.se3 import apply
from recon.core.settings import Settings
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, PointCloud
from recon.core.values.arrays import Bool, Float64, Int64, UInt8
from recon.map.ground.surface import GroundSurface, Raster

UNSURE: Final = -2
"""A cell that was seen, but not well enough to tell whether a robot can drive there."""
FRICTION: Final = 0.5
"""Of rubber on wet asphalt. With all wheels driven, those on the ground push the one at a step,
whose normal then leans back by up to twice the angle of friction, atan(μ): it climbs a step of
1 - cos(2 · atan(μ)) = 2μ² / (1 + μ²) of its radius."""
_FREE_P: Final = 0.023  # of being over the limit: the measured value is two deviations below
_LETHAL_P: Final = 0.9
_GRADED: Final = 0.5
"""Largest deviation, in limits, with which something near a limit has a cost: flat ground and twice
the limit are two deviations from it."""
_WINDOW_PX: Final = 6.5  # by which matching moves an edge: half of a window of 11, and a pixel
_LEAST_SIGMA_M: Final = 0.003  # roughness of what wheels roll on
_FRAMES: Final = 2  # that must have seen a cell
_CORRELATION: Final = 0.3
"""Of the errors of a height by two frames: they see the same texture from nearly the same place, so
that many of them are hardly better than a few (decision 0060)."""
_FLATTEST: Final = 0.02  # sine of the flattest view of the ground that is used
_PRIOR: Final = 1.0
"""Standard deviation of slopes (100 %) and steps (1 m) before anything is seen, so that they are
uncertain, not wrong, where cells on one side are missing."""


class RobotSettings(Settings):
    """The robot that a costmap is made for."""

    width_m: float = Field(0.6, ge=0.01, le=20.0)
    """Width of the robot: its middle stays half of it away from obstacles, and from what is
    unknown."""
    wheel_radius_m: float = Field(0.15, ge=0.005, le=5.0)
    """Radius of its wheels, which bridge gaps up to that length."""
    max_step_m: float | None = Field(None, ge=0.001, le=5.0)
    """Highest step, up or down; none = 0.4 of the radius, which driven wheels climb when wet."""
    max_slope_percent: float = Field(20.0, ge=0.1, le=200.0)
    """Steepest slope, in any direction."""

    @property
    def step_m(self) -> float:
        ratio = 2 * FRICTION**2 / (1 + FRICTION**2)
        return ratio * self.wheel_radius_m if self.max_step_m is None else self.max_step_m


@dataclass(frozen=True, eq=False)
class Relief:
    """Heights of what wheels roll on; float64 (rows, columns), NaN = not seen."""

    raster: Raster
    height_m: Float64
    sigma_m: Float64  # standard deviation of the height
    blur_m2: Float64  # (3, rows, columns), xx, xy and yy of the squared length of the blur


def measure_relief(
    frames: Iterable[tuple[PointCloud, Float64]],
    ground: GroundSurface,
    raster: Raster,
    most_m: float,
    focal_px: float,
) -> Relief:
    """Measure the height of each cell by rays of frames, camera axes, at their ``T_map_camera``.

    What is more than ``most_m`` above the ``ground`` is left out. ``focal_px`` is that of the
    images, which matching blurs.
    """
    sums = np.zeros((raster.shape[0] * raster.shape[1], 9))
    for cloud, T_map_camera in frames:
        xyz = apply(T_map_camera, cloud.xyz.astype(np.float64))
        cell, used = raster.cells_of(xyz[:, :2])
        used[used] = xyz[used, 2] - ground.height_at(xyz[used, :2]) < most_m
        if used.any() and cloud.sigma_m is not None:
            rays, height = xyz[used] - T_map_camera[:3, 3], xyz[used, 2]
            sigma_m = cloud.sigma_m[used].astype(np.float64)
            cells, values = _one_frame(cell[used], rays, height, sigma_m, _WINDOW_PX / focal_px)
            sums[cells] += values
    frames_seen, total, z, zz, variance, squares, *blur = sums.T.reshape(-1, *raster.shape)
    # What one frame saw may have moved, or be mismatched.
    weight = np.where(frames_seen >= _FRAMES, total, np.nan)
    height_m, ratio = z / weight, squares / weight**2
    # The error of one frame: as its points say, or as frames differ, which is what they have not in
    # common. Of the mean of many, what they have in common stays.
    differ = (1 - _CORRELATION) * np.maximum(1 - ratio, 0.1)  # hidden if one outweighs all
    scatter = np.maximum(zz / weight - height_m**2, 0.0) / differ
    stays = _CORRELATION + (1 - _CORRELATION) * ratio
    sigma_m = np.sqrt(np.maximum(variance / weight, scatter) * stays + _LEAST_SIGMA_M**2)
    return Relief(raster, height_m, sigma_m, np.stack([one / weight for one in blur]))


def _one_frame(
    cell: Int64, rays: Float64, height_m: Float64, sigma_m: Float64, blur_rad: float
) -> tuple[Int64, Float64]:
    """Return cells, each once, and what is added to their sums (N, 9)."""
    away, level = np.linalg.norm(rays, axis=1), np.linalg.norm(rays[:, :2], axis=1)
    sine = np.maximum(np.abs(rays[:, 2]) / away, _FLATTEST)
    along, across = np.hypot(sigma_m * level / away, blur_rad * away / sine), blur_rad * away
    x, y = (rays[:, :2] / np.maximum(level, 1e-9)[:, None]).T
    stretch = along**2 - across**2
    columns = [height_m, height_m**2, sigma_m * sine]
    columns += [across**2 + stretch * x**2, stretch * x * y, across**2 + stretch * y**2]
    cells, home = np.unique(cell, return_inverse=True)
    z, zz, sigma, xx, xy, yy = [np.bincount(home, one) for one in columns] / np.bincount(home)
    # So steeply that far views hardly blur what near ones show.
    w = (xx + yy) ** -2.0
    ones = np.ones_like(w)
    return cells, np.stack([ones, w, w * z, w * zz, w * sigma**2, w**2, w * xx, w * xy, w * yy], 1)


class Judged(NamedTuple):
    """How cells stand against a limit; float64 (rows, columns)."""

    value: Float64  # as measured
    sure: Float64  # probability that what is measured is over the limit
    possible: Float64  # probability that what may be hidden in it is
    sigma: Float64  # standard deviation of that, in limits


def judge(relief: Relief, robot: RobotSettings) -> tuple[Judged, Judged]:
    """Return steps (metres) and slopes (rise over run), the worst at each cell.

    Both are fitted to the cells within half of the width: a plane, and to it a step across the
    cell in four directions, or a bump or hole around it. NaN far from all that was seen.
    """
    fit = _Fit(relief, max(2, round(robot.width_m / 2 / relief.raster.cell_m)))
    steps = Judged(*np.zeros((4, *relief.raster.shape)))
    for one in fit.steps(robot.step_m):
        steps = Judged(*map(np.fmax, steps, one))
    return steps, fit.slopes(robot.max_slope_percent / 100)


class _Fit:
    """Weighted least squares in the window around each cell of a relief."""

    def __init__(self, relief: Relief, reach: int) -> None:
        self._cell_m, self._reach, self._blur_m2 = relief.raster.cell_m, reach, relief.blur_m2
        self._y, self._x = np.mgrid[-reach : reach + 1, -reach : reach + 1] * self._cell_m
        # Cells within a blur are off alike, which looks like a step or slope where there is none.
        xx, xy, yy = relief.blur_m2
        area = np.sqrt(np.maximum(xx * yy - xy**2, 0.0))
        self._alike = np.sqrt(1.0 + np.nan_to_num(area) / self._cell_m**2)
        self._weight = np.nan_to_num(relief.sigma_m**-2.0)
        middle_m = np.nanmedian(relief.height_m) if self._weight.any() else 0.0
        self._height_m = np.nan_to_num(relief.height_m - middle_m)

    def slopes(self, limit: float) -> Judged:
        beta, covariance, _ = self._solve(np.ones_like(self._x))
        slope = np.linalg.norm(beta[..., 1:3], axis=-1)
        sigma = np.sqrt(covariance[..., [1, 2], [1, 2]].max(axis=-1))
        return self._judged(slope, sigma, slope, sigma, limit)

    def steps(self, limit_m: float) -> Iterator[Judged]:
        """Yield steps across the cell in each direction; then bumps."""
        for turn in np.pi / 4 * np.arange(4):
            direction = np.array([np.cos(turn), np.sin(turn)])
            side_m = direction[0] * self._x + direction[1] * self._y
            # The cells in between may lie on both sides.
            used = (np.abs(side_m) > 0.6 * self._cell_m).astype(np.float64)
            beta, covariance, doubt = self._solve(used, 0.5 * used * np.sign(side_m))
            products = direction[[0, 0, 1]] * direction[[0, 1, 1]] * [1, 2, 1]
            blur_m = np.sqrt(np.einsum("k...,k", self._blur_m2, products))
            # A step, and with what rises along it: errors of both are opposite, and mostly cancel.
            risen = np.concatenate(
                [blur_m[..., None] * direction, np.ones((*blur_m.shape, 1))], axis=-1
            )
            most_m = np.abs(np.einsum("...i,...i", risen, beta[..., 1:]))
            spread = np.einsum("...i,...ij,...j", risen, covariance[..., 1:, 1:], risen)
            step_m, sigma_m = np.abs(beta[..., 3]), np.sqrt(covariance[..., 3, 3])
            yield self._judged(step_m, doubt * sigma_m, step_m, sigma_m, limit_m)
            yield self._judged(step_m, doubt * sigma_m, most_m, np.sqrt(spread), limit_m)
        inner = max(1, self._reach // 2) + 0.5
        bump = np.maximum(np.abs(self._x), np.abs(self._y)) < inner * self._cell_m
        beta, covariance, doubt = self._solve(np.ones_like(self._x), bump)
        bump_m, sigma_m = np.abs(beta[..., 3]), np.sqrt(covariance[..., 3, 3])
        # What is blurred over more than its own size is lower by as much.
        blur_m2 = self._blur_m2[0] + self._blur_m2[2]
        fades = np.sqrt(1 + blur_m2 / (2 * inner * self._cell_m) ** 2)
        yield self._judged(bump_m, doubt * sigma_m, bump_m * fades, sigma_m * fades, limit_m)

    def _solve(
        self, used: Float64, extra: Float64 | None = None
    ) -> tuple[Float64, Float64, Float64]:
        """Return height, slopes and perhaps the extra coefficient (..., 3 or 4), and covariances.

        Also by how much more deviations are if what is stated of heights is believed (at least 1).
        """
        basis = [used, used * self._x, used * self._y] + ([] if extra is None else [extra])
        w, z, n = self._weight, self._height_m, len(basis)
        normal, right = np.empty((*w.shape, n, n)), np.empty((*w.shape, n))
        for i, one in enumerate(basis):
            right[..., i] = _sum_around(w * z, one)
            for j, other in enumerate(basis[: i + 1]):
                normal[..., i, j] = normal[..., j, i] = _sum_around(w, one * other)
        prior = _PRIOR**-2 * np.eye(n)
        beta = np.linalg.solve(normal + prior, right[..., None])[..., 0]
        left = np.maximum(_sum_around(w * z**2, used) - np.einsum("...i,...i", beta, right), 0.0)
        spare = np.maximum(_sum_around((w > 0).astype(np.float64), used) - n, 0.0)
        # How well it fits says what part of the errors differs within the window, which is all that
        # looks like a step; what is stated counts as one more cell.
        fit = (1 + left) / (1 + spare)
        scale = (self._alike**2 * fit)[..., None]
        covariance = np.linalg.inv(normal / scale[..., None] + prior)
        beta = np.einsum("...ij,...j", covariance, right / scale)
        return beta, covariance, np.maximum(1.0, fit**-0.5)

    def _judged(
        self, value: Float64, sigma: Float64, most: Float64, most_sigma: Float64, limit: float
    ) -> Judged:
        sure, possible = (value - limit) / sigma, (most - limit) / most_sigma
        return Judged(value, ndtr(sure), ndtr(possible), most_sigma / limit)


def _sum_around(values: Float64, kernel: Float64) -> Float64:
    summed = cv2.filter2D(values, cv2.CV_64F, kernel, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(summed, np.float64)


def costs(
    relief: Relief, steps: Judged, slopes: Judged, robot: RobotSettings, grid: OccupancyGrid
) -> tuple[OccupancyGrid, UInt8]:
    """Return the cost of driving over each cell: 0 = free, 100 = not possible; UNKNOWN, `UNSURE`.

    Others are the probability in percent of being over a limit, which is also returned for cells
    that are UNSURE, uint8 (rows, columns). ``grid`` is what stands on the ground, up to the height
    of the robot, in the same cells.
    """
    worst = Judged(*map(np.fmax, steps, slopes))
    possible = np.nan_to_num(worst.possible, nan=1.0)
    risk = np.rint(100 * possible).clip(0, OCCUPIED - 1).astype(np.uint8)
    risk[possible <= _FREE_P] = FREE
    # What is smaller than the blur leaves hardly a trace, such as a ditch that the robot sinks in.
    sharp = np.sqrt(relief.blur_m2[0] + relief.blur_m2[2]) <= robot.width_m
    known = (risk == FREE) | (sharp & (worst.sigma <= _GRADED) & (possible <= 0.5))
    cells = np.where(known, risk.astype(np.int8), np.int8(UNSURE))
    reach = int(robot.wheel_radius_m / relief.raster.cell_m) + 1
    rolled = np.isfinite(relief.height_m).astype(np.uint8)
    rolled = cv2.morphologyEx(rolled, cv2.MORPH_CLOSE, np.ones((reach, reach), np.uint8))
    cells[(rolled == 0) | (grid.cells == UNKNOWN)] = UNKNOWN
    cells[(worst.sure >= _LETHAL_P) | (grid.cells == OCCUPIED)] = OCCUPIED
    return OccupancyGrid(cells, grid.resolution_m, grid.origin_m), risk


def widened(grid: OccupancyGrid, risk: UInt8, robot: RobotSettings, driven: Bool) -> OccupancyGrid:
    """Return costs of the middle of the robot, of costs and risks of what it stands on.

    It is not where an obstacle or something unknown is within half of its width; elsewhere its cost
    is the largest there, of cells that are UNSURE their risk. ``driven`` (rows, columns) are cells
    that a vehicle took up: what is unknown there is free.
    """

    def near(cells: Bool) -> Bool:
        away = cv2.distanceTransform((~cells).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        # What is in a cell may be anywhere in it.
        return np.asarray((away - 0.5) * grid.resolution_m < robot.width_m / 2)

    cells = np.where(driven & (grid.cells < 0), np.int8(FREE), grid.cells)
    none = (cells == UNKNOWN) | (cells == OCCUPIED) | (driven & (grid.cells < 0))
    risk = np.where(none, FREE, risk)
    out = cells.copy()
    seen = (cells >= FREE) & (cells < OCCUPIED) & ~driven
    for level in np.unique(risk[risk > FREE]).tolist():
        out[seen & near(risk >= level)] = level
    out[near(cells == UNKNOWN) & ~driven & (out >= 0)] = UNKNOWN
    out[near(cells == OCCUPIED)] = OCCUPIED
    return OccupancyGrid(out, grid.resolution_m, grid.origin_m)
