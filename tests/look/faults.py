"""Ten common faults of recordings, injected into a drive without faults."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np

from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import CameraIntrinsics, RectifiedCamera, StereoCalibration, StereoPair
from recon.sources.source import StereoSource


@dataclass(frozen=True, eq=False)
class Spoiled(StereoSource):
    """A source with modified pairs of another one; ``take(i)`` gives pair i."""

    camera: RectifiedCamera | StereoCalibration
    count: int
    take: Callable[[int], StereoPair]
    name: str = "spoiled"
    description: str = "a drive with a planted fault"

    @cached_property
    def calibration(self) -> RectifiedCamera | StereoCalibration:
        return self.camera

    def __len__(self) -> int:
        return self.count

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        return (replace(self.take(index), index=index) for index in range(start, self.count))


def at(source: StereoSource, index: int) -> StereoPair:
    return next(iter(source.frames(index)))


def rectified(source: StereoSource) -> RectifiedCamera:
    return source.calibration


def changed(source, change):
    def take(index: int) -> StereoPair:
        pair = at(source, index)
        left, right = change(pair.left, pair.right)
        return replace(pair, left=left, right=right)

    return Spoiled(rectified(source), len(source), take)


def turned(source: StereoSource, pitch_deg=0.0, roll_deg=0.0, yaw_deg=0.0, enlarged=1.0) -> Spoiled:
    """The right camera turned, and its lens changed: another view from the same place."""
    camera = rectified(source)
    K = camera.matrix.copy()
    K[0, 2] = camera.cx_right_px
    R = exp_so3(np.radians([pitch_deg, yaw_deg, roll_deg]))
    H = K @ np.diag([enlarged, enlarged, 1.0]) @ R @ np.linalg.inv(K)
    size = (camera.width_px, camera.height_px)
    return changed(source, lambda left, right: (left, warped(right, H, size)))


def unrectified(source, left_rad, right_rad, pitch_deg=0.0):
    """Cameras rotated relative to their rectified orientation, and calibrated so.

    The right one is off its calibration by ``pitch_deg``.
    """
    camera = rectified(source)
    K, R_left, R_right = camera.matrix, exp_so3(left_rad), exp_so3(right_rad)
    error = exp_so3(np.radians([pitch_deg, 0.0, 0.0]))
    warps = [K @ R @ np.linalg.inv(K) for R in (R_left, error @ R_right)]
    size = (camera.width_px, camera.height_px)
    lens = CameraIntrinsics(K, np.zeros(0), *size)
    centre_m = np.array([camera.baseline_m, 0.0, 0.0])
    T_right_left = make_transform(R_right @ R_left.T, -R_right @ centre_m)
    images = changed(
        source, lambda left, right: (warped(left, warps[0], size), warped(right, warps[1], size))
    )
    return replace(images, camera=StereoCalibration(lens, lens, T_right_left))


def warped(image: np.ndarray, H: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return np.asarray(cv2.warpPerspective(image, H, size))


def offset(source: StereoSource, frames: int) -> Spoiled:
    def take(index: int) -> StereoPair:
        return replace(at(source, index + frames), right=at(source, index).right)

    return Spoiled(rectified(source), len(source) - frames, take)


def duplicated(source: StereoSource, every: int = 5) -> Spoiled:
    """Every fifth frame is written twice, with increasing times."""
    order = [k for k in range(len(source)) for _ in range(2 if k % every == every - 1 else 1)]
    step_s = at(source, 1).timestamp_s - at(source, 0).timestamp_s

    def take(index: int) -> StereoPair:
        return replace(at(source, order[index]), timestamp_s=index * step_s)

    return Spoiled(rectified(source), len(order), take)


def tenfold_baseline(source: StereoSource) -> Spoiled:
    camera = rectified(source)
    wider = replace(camera, baseline_m=10 * camera.baseline_m)
    return Spoiled(wider, len(source), lambda index: at(source, index))


def half_as_large(source: StereoSource) -> Spoiled:
    return changed(source, lambda left, right: (left[::2, ::2].copy(), right[::2, ::2].copy()))


def wrong_size(source: StereoSource) -> Spoiled:
    """The images are half as large as those that were calibrated."""
    half = half_as_large(source)

    def take(index: int) -> StereoPair:
        pair = half.take(index)
        raise CalibrationError("images have another size than the calibration", where=pair.name)

    return replace(half, take=take)


def silently_wrong_size(source: StereoSource) -> Spoiled:
    """The same, with a calibration file that does not contain the image size."""
    half = half_as_large(source)
    height, width = half.take(0).left.shape[:2]
    return replace(half, camera=replace(rectified(half), width_px=width, height_px=height))


Change = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
CHANGES: dict[str, tuple[str, Change]] = {
    "swapped": ("swapped", lambda left, right: (right, left)),
    "rows 2 px down": ("rows", lambda left, right: (left, np.roll(right, 2, axis=0))),
    "gain of 1.4": ("gain", lambda left, right: (left, cv2.convertScaleAbs(right, alpha=1.4))),
    "right camera blurred": ("blur", lambda left, right: (left, blurred(right))),
    "both cameras blurred": ("blur", lambda left, right: (blurred(left), blurred(right))),
    "right camera black": ("black", lambda left, right: (left, 0 * right)),
}
blurred = partial(cv2.GaussianBlur, ksize=(0, 0), sigmaX=2.0)
FAULTS: dict[str, tuple[str, Callable[[StereoSource], Spoiled]]] = {
    **{name: (code, partial(changed, change=change)) for name, (code, change) in CHANGES.items()},
    "lag of three frames": ("lag", lambda s: offset(s, 3)),
    "roll of 1 degree": ("rows", lambda s: turned(s, roll_deg=1.0)),
    "duplicated frames": ("duplicates", duplicated),
    "baseline times ten": ("baseline", tenfold_baseline),
    "wrong size": ("size", wrong_size),
    "wrong size untold": ("size", silently_wrong_size),
}
