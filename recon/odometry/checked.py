"""An odometry whose poses are checked: uncertain and contradicted ones are marked.

Features may agree on a motion that is not the camera's: that of a lorry ahead, or none at all where
they slide along the edge of a road. Then the rest of the image contradicts: its patches, moved
accordingly, do not match what is seen there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import cv2
import numpy as np

from recon.core.geometry.se3 import apply, invert
from recon.core.text import counted
from recon.core.values import Disparity, RectifiedCamera
from recon.core.values.arrays import Bool, Float64, Int64, UInt8, tree_of
from recon.core.values.camera import depth_from_disparity, project, unproject
from recon.odometry.protocol import Odometry, OdometryFrame, OdometryHealth, OdometryResult, pose_in
from recon.stereo.rectify.rectifier import LEAST_NOISE, noise_sigma

_MAX_SIGMA_M: Final = 0.05  # largest standard deviation of a trusted motion on a road
_MAX_SIGMA_RATIO: Final = 0.05  # fraction of the motion's length that is added to it
_MIN_TELLING: Final = 8  # with fewer usable patches the images say nothing
MIN_RATIO: Final = 0.6  # least fraction of patches that must agree with a trusted motion


class CheckedOdometry:
    """Checks how certain every motion is, and whether the image agrees with it.

    Poses stay as they are; ``health.ok`` and its notes say which are not to be trusted. ``scale``
    is the size of the scene against a road.
    """

    def __init__(self, odometry: Odometry, scale: float = 1.0) -> None:
        self.odometry, self._scale = odometry, scale
        self._last: tuple[Sight, Float64] | None = None  # the last frame, and its pose

    def register(self, frame: OdometryFrame) -> OdometryResult:
        result, last = self.odometry.register(frame), self._last
        if last is None and not result.health.ok:
            return result
        sight = Sight(frame.pair.left, frame.disparity)
        self._last = sight, result.T_world_camera
        if last is None or not result.health.ok or result.health.begins:
            return result
        T_before_now = invert(last[1]) @ result.T_world_camera
        doubts = self._doubts(result.health, (last[0], sight), T_before_now, frame.pair.camera)
        notes = (*result.health.notes, *doubts)
        return replace(result, health=replace(result.health, ok=not doubts, notes=notes))

    def state(self) -> dict[str, Any]:
        last = None
        if self._last is not None:
            sight, T = self._last
            last = {"left": sight.left, "disparity": tree_of(sight.disparity), "T_world_camera": T}
        return {"odometry": self.odometry.state(), "last": last}

    def restore(self, state: dict[str, Any]) -> None:
        self.odometry.restore(state["odometry"])
        last, self._last = state["last"], None
        if last is not None:
            sight = Sight(last["left"], Disparity(**last["disparity"]))
            self._last = sight, pose_in(last, "T_world_camera")

    def _doubts(
        self,
        health: OdometryHealth,
        views: tuple[Sight, Sight],
        T_before_now: Float64,
        camera: RectifiedCamera,
    ) -> list[str]:
        """What speaks against a motion; empty where it is to be trusted."""
        length_m = float(np.linalg.norm(T_before_now[:3, 3]))
        if health.sigma_m > most_sigma_m(length_m, self._scale):
            return [f"the motion is known to {health.sigma_m:.2g} m only"]
        found = explain_motion(*views, T_before_now, camera)
        telling = found.informative >= _MIN_TELLING
        # A visual motion has passed the test of its uncertainty; any other has no other evidence.
        trusted = found.ratio >= MIN_RATIO if telling else np.isfinite(health.sigma_m)
        if trusted:
            return []
        patches = counted(found.informative, "patch", "patches")
        if telling:
            return [f"only {100 * found.ratio:.0f} % of {patches} of the image moved like that"]
        return [f"only {patches} of the image can distinguish motions"]


def most_sigma_m(length_m: float, scale: float) -> float:
    """Return the largest standard deviation of a trusted motion of that length."""
    # Among near things steps are long, and loops hold the path: there it may be more.
    return min(1.0, 2.5 * scale) * _MAX_SIGMA_M + _MAX_SIGMA_RATIO * length_m


_STRIDE_PX: Final = 5  # every n-th row and column is sampled
_PATCH_PX: Final = 48  # edge of a patch
_MIN_PIXELS: Final = 24  # least number of samples with a disparity in a patch
_MIN_TEXTURE: Final = 3.0
"""A patch is used if its mean squared gradient, in the direction in which it is smallest, exceeds
that of the noise by this factor."""

_MIN_CORRELATION: Final = 0.6  # least correlation of a patch that agrees


@dataclass(frozen=True)
class Agreement:
    """How many patches of an image a motion explains."""

    informative: int  # patches with texture in all directions, which can distinguish motions
    ratio: float  # fraction of them that match where the motion takes them; NaN = there are none


@dataclass(frozen=True, eq=False)
class Sight:
    """What the check needs of a frame."""

    left: UInt8  # (H, W)
    disparity: Disparity

    @cached_property
    def noise(self) -> float:
        """Standard deviation of the noise of the image, grey values."""
        return noise_sigma(self.left)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Pixels of an image that another image should show too."""

    patch: Int64  # (N,), number of the patch of each
    before: Float64  # (N,), grey values in the last image
    now: Float64  # (N,), grey values where the motion takes them in this one
    slope: Float64  # (N, 2), gradient of ``before`` per pixel to the right and down


def explain_motion(
    before: Sight, now: Sight, T_before_now: Float64, camera: RectifiedCamera
) -> Agreement:
    """Count the patches of the last image that match where a motion takes them in this one.

    Every sampled pixel with a disparity is moved. A patch matches where its grey values correlate
    with those seen there, corrected for noise; brightness and contrast may change. Patches without
    texture, or with edges in one direction alone, match after many motions and are not counted; in
    an image that is dark by now no patch is.
    """
    samples = _sample(before, now.left, T_before_now, camera)
    count = np.bincount(samples.patch)
    noise = (before.noise, now.noise)
    informative = (count >= _MIN_PIXELS) & _textured(samples, count, noise[0])
    # An image that shows little more than noise where the patches should be is blind.
    blind = _power(samples, samples.now, count) < 2.0 * noise[1] ** 2
    if not informative.any() or blind[informative].mean() > 0.5:
        return Agreement(0, float("nan"))
    agreeing = _correlation(samples, count, noise)[informative] >= _MIN_CORRELATION
    return Agreement(int(informative.sum()), float(agreeing.mean()))


def _sample(before: Sight, left: UInt8, T_before_now: Float64, camera: RectifiedCamera) -> _Samples:
    """Every n-th pixel with a disparity that stays in the image."""
    step, (height, width) = _STRIDE_PX, left.shape
    # Slopes need a neighbour on either side.
    row, column = np.nonzero(before.disparity.valid[1:-1:step, 1:-1:step])
    row, column = 1 + step * row, 1 + step * column
    depth_m = depth_from_disparity(before.disparity.values[row, column], camera)
    xyz = unproject(column, row, depth_m.astype(np.float64), camera)
    u, v, _ = project(apply(invert(T_before_now), xyz), camera)
    with np.errstate(invalid="ignore"):
        inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    row, column, u, v = row[inside], column[inside], u[inside], v[inside]
    grey = before.left.astype(np.int16)
    right, down = (grey[row, column + 1], grey[row + 1, column])
    slope = np.stack([right - grey[row, column - 1], down - grey[row - 1, column]], axis=1)
    patch = (row // _PATCH_PX) * -(-width // _PATCH_PX) + column // _PATCH_PX
    values = grey[row, column].astype(np.float64)
    return _Samples(patch, values, _interpolated(left, u, v), 0.5 * slope)


def _interpolated(image: UInt8, u: Float64, v: Float64) -> Float64:
    """Grey values (N,) between pixels."""
    if not len(u):
        return np.zeros(0)
    # OpenCV refuses maps of more than 32767 rows, so the points are wrapped into rows.
    rows = -(-len(u) // 1024)
    columns, lines = (np.resize(x.astype(np.float32), (rows, 1024)) for x in (u, v))
    grey = np.asarray(cv2.remap(image, columns, lines, cv2.INTER_LINEAR), dtype=np.float64)
    return grey.reshape(-1)[: len(u)]


def _textured(samples: _Samples, count: Int64, sigma: float) -> Bool:
    """Patches (P,) with gradients in every direction that exceed the noise."""
    x, y = samples.slope.T
    xx, yy, xy = (_mean(samples, values, count) for values in (x * x, y * y, x * y))
    least = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    # Half the difference of two noisy values has half their variance.
    return np.asarray(least > _MIN_TEXTURE * 0.5 * sigma**2)


def _correlation(samples: _Samples, count: Int64, noise: tuple[float, float]) -> Float64:
    """The correlation (P,) of each patch between the two images, corrected for noise."""
    one, other = samples.before, samples.now
    mean, mean_other = (_mean(samples, values, count) for values in (one, other))
    both = _mean(samples, one * other, count) - mean * mean_other
    power, power_other = (
        _power(samples, values, count) - sigma**2
        for values, sigma in zip((one, other), noise, strict=True)
    )
    floor = LEAST_NOISE**2
    return np.asarray(both / np.sqrt(np.maximum(power, floor) * np.maximum(power_other, floor)))


def _power(samples: _Samples, values: Float64, count: Int64) -> Float64:
    """The variance of values (N,) in each patch, noise included."""
    return _mean(samples, values**2, count) - _mean(samples, values, count) ** 2


def _mean(samples: _Samples, values: Float64, count: Int64) -> Float64:
    """The mean of values (N,) in each patch; 0 in empty ones."""
    return np.asarray(np.bincount(samples.patch, values) / np.maximum(count, 1))


class SegmentCounter:
    """Numbers the segments of a drive: in one, poses are measured from one another.

    A new one begins where odometry began anew, and after a pose that is not to be trusted unless it
    was skipped: where it lies beside the one before is a guess.
    """

    def __init__(self) -> None:
        self.number = 0
        self.begun = self._lost = False

    def add(self, record: OdometryHealth) -> int:
        """Return the segment of the next frame; -1 = its pose is not to be trusted."""
        if not record.ok:
            self._lost |= not record.skipped
            return -1
        if self.begun and (self._lost or record.begins):
            self.number += 1
        self.begun, self._lost = True, False
        return self.number
