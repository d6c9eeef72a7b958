"""A drive around a block and one past alike houses: some frames of each, with exact disparity."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

from recon.core.geometry import se3
from recon.core.values import Disparity, Reason, RectifiedPair, Trajectory
from recon.odometry.protocol import OdometryHealth
from recon.places.closure import DrivePath
from recon.places.detector import LoopDetector, StoredKeyframe
from recon.places.keyframe import Keyframe, make_keyframe
from recon.places.places import Loop, path_lengths
from recon.street.render import StreetCamera
from recon.street.settings import CORNER_M, StreetScene
from recon.street.street import build_street

BLOCK_M = (80.0, 60.0)
LAP_M = 2 * sum(BLOCK_M) - 8 * CORNER_M + 2 * math.pi * CORNER_M
LAP = 168  # frames: frame 168 stands where frame 0 stood
PERIOD = 40  # frames after which the repeated street looks the same


class KeyframeMemory(dict[int, StoredKeyframe]):
    """Keeps keyframes in memory, for short drives."""

    def __iter__(self) -> Iterator[StoredKeyframe]:
        return iter(self.values())

    def put(self, stored: StoredKeyframe) -> None:
        self[stored.keyframe.frame] = stored

    get = dict.__getitem__

    @property
    def frames(self) -> list[int]:
        return sorted(self.keys())


class Filmed:
    """A drive whose frames are rendered once, when they are first asked for, and its true path."""

    def __init__(self, **street: Any) -> None:
        size = {"width_px": 320, "height_px": 120, "focal_px": 180.0, "smooth_edges": False}
        self.camera = StreetCamera(build_street(StreetScene(**street, **size)))
        self.truth = self.camera.world.trajectory
        self.frame = cache(self._frame)

    def _frame(self, index: int) -> tuple[RectifiedPair, Disparity]:
        """A pair and the truth where both cameras see, with an error of a quarter of a pixel."""
        seen, weights = self.camera.pair(index), [0.299, 0.587, 0.114]
        both = (np.rint(side @ weights).astype(np.uint8) for side in (seen.left, seen.right))
        truth = self.camera.disparity_truth(index)
        noise = np.random.default_rng(index).normal(0.0, 0.25, truth.values.shape)
        values = np.where(truth.nonocc, truth.values + noise, np.nan).astype(np.float32)
        valid = np.isfinite(values)
        sigma_px = np.where(valid, 0.25, np.nan).astype(np.float32)
        reason = np.where(valid, Reason.VALID, Reason.OCCLUDED).astype(np.uint8)
        disparity = Disparity(values, valid.astype(np.float32), sigma_px, reason)
        return RectifiedPair(*both, self.camera.world.camera, index=index), disparity

    def motion(self, first: int, last: int) -> np.ndarray:
        poses = self.truth.T_world_camera
        return se3.invert(poses[first]) @ poses[last]

    def keyframe(self, index: int) -> Keyframe:
        return make_keyframe(index, *self.frame(index))

    def detect(self, frames, path: Trajectory, segments=None):
        """A detector that has seen some frames, and the path up to each frame.

        ``segments`` has those of frames that are not of segment 0.
        """
        segment = [(segments or {}).get(k, 0) for k in range(len(path))]
        path_m = path_lengths(path.T_world_camera, np.array(segment) >= 0)
        detector = LoopDetector(KeyframeMemory(), self.camera.world.camera)
        for k in frames:
            pose = path.T_world_camera[k]
            detector.add(k, *self.frame(k), pose, path_m=path_m[k], segment=segment[k])
        return detector, path_m


@pytest.fixture(scope="session")
def block() -> Filmed:
    speed = LAP_M / LAP
    return Filmed(path="block", block_m=BLOCK_M, frames=LAP + 20, speed_m_per_frame=speed, seed=1)


@pytest.fixture(scope="session")
def alike() -> Filmed:
    speed = 60.0 / PERIOD
    return Filmed(path="straight", repeat_m=60.0, frames=60, speed_m_per_frame=speed, seed=2)


def drifted(truth: Trajectory, *, ratio: float, turn_deg_per_m: float) -> Trajectory:
    """A path with a constant scale and rotation error in each step."""
    poses = [np.eye(4)]
    for step in se3.invert(truth.T_world_camera[:-1]) @ truth.T_world_camera[1:]:
        length = float(np.linalg.norm(step[:3, 3]))
        turn = se3.exp_so3(np.radians([0.1, 1.0, 0.0]) * turn_deg_per_m * length)
        longer = se3.make_transform(step[:3, :3] @ turn, step[:3, 3] * (1.0 + ratio))
        poses.append(poses[-1] @ longer)
    return Trajectory(np.stack(poses), truth.timestamps_s)


def drive_path(path: Trajectory) -> DrivePath:
    """A path that odometry measured without a break."""
    return DrivePath.of(path, [OdometryHealth(ok=True)] * len(path))


INFORMATION = np.diag([0.05**-2] * 3 + [0.003**-2] * 3)


def true_loop(truth: Trajectory, first: int, last: int) -> Loop:
    """The loop that two frames of a path give."""
    T_first_last = se3.invert(truth.T_world_camera[first]) @ truth.T_world_camera[last]
    return Loop(first, last, T_first_last, INFORMATION, 100, 1.0)


@pytest.fixture(scope="module")
def odometry(truth: Trajectory) -> Trajectory:
    """The path of a test module, as odometry would have it."""
    return drifted(truth, ratio=0.01, turn_deg_per_m=0.02)
