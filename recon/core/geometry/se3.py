"""Rigid transforms (4×4), rotations as matrices, vectors and quaternions (x, y, z, w), axes.

``T_a_b`` maps points of frame b to frame a. Also how sure a step is, and a motion that goes on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError
from recon.core.values import Frame, PointCloud
from recon.core.values.arrays import Float64

FARTHEST_M: Final = 1e5  # from the first camera, or along a ray: farther than any drive
_RIGID_TOLERANCE: Final = 1e-6


def make_transform(rotation: NDArray[Any], translation_m: NDArray[Any]) -> Float64:
    """Return a 4×4 transform from a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = np.asarray(translation_m).reshape(3)
    return T


def invert(T: NDArray[Any]) -> Float64:
    """Return the inverse of one rigid transform (4, 4) or of a stack (…, 4, 4)."""
    rotation = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse = np.zeros(T.shape)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, T[..., :3, 3])
    inverse[..., 3, 3] = 1.0
    return inverse


def apply(T: NDArray[Any], xyz: NDArray[Any]) -> NDArray[Any]:
    """Transform points (N, 3); the result keeps the floating dtype of ``xyz``."""
    moved = xyz @ T[:3, :3].T.astype(xyz.dtype) + T[:3, 3].astype(xyz.dtype)
    return np.asarray(moved)


def rotate(T: NDArray[Any], directions: NDArray[Any]) -> NDArray[Any]:
    """Rotate directions (N, 3), such as normals."""
    return np.asarray(directions @ T[:3, :3].T.astype(directions.dtype))


def angle_rad(T: NDArray[Any]) -> Float64:
    """Return the rotation angle of one transform or of a stack, in [0, π]."""
    # atan2 is accurate near 0 and π, where acos of the trace loses half of the digits.
    R = T[..., :3, :3]
    axis = np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]],
        axis=-1,
    )
    sine = 0.5 * np.linalg.norm(axis, axis=-1)
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0)
    return np.asarray(np.arctan2(sine, cosine))


def hat(w: NDArray[Any]) -> Float64:
    """Return the cross-product matrix of a vector (3,), or of each of a stack (…, 3)."""
    matrix = np.zeros((*w.shape, 3))
    matrix[..., [2, 0, 1], [1, 2, 0]] = w
    matrix[..., [1, 2, 0], [2, 0, 1]] = -w
    return matrix


def exp_so3(w: NDArray[Any]) -> Float64:
    """Return the rotation matrix of a rotation vector, radians (Rodrigues); stacks as `hat`."""
    vectors = np.asarray(w, dtype=np.float64)
    K = hat(vectors)
    angles = np.sqrt(vectors[..., None, :] @ vectors[..., :, None])
    # How much the cross-product matrix counts, and its square.
    factors = [
        (1.0, 0.5) if w < 1e-8 else (math.sin(w) / w, (1.0 - math.cos(w)) / w**2)
        for w in angles.ravel().tolist()
    ]
    a, b = np.array(factors).T.reshape(2, *angles.shape)
    return np.asarray(np.eye(3) + a * K + b * K @ K)


def log_so3(R: NDArray[Any]) -> Float64:
    """Return the rotation vector (3,), radians, of a rotation matrix; at π with either sign."""
    sine_axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = float(np.linalg.norm(sine_axis)), 0.5 * (float(np.trace(R)) - 1.0)
    if cosine > 0.0:
        return sine_axis * (math.asin(min(sine, 1.0)) / sine if sine > 1e-12 else 1.0)
    # Near π the sine vanishes; R + Rᵀ still determines the axis, but not its sign.
    outer = 0.5 * (R + R.T) - cosine * np.eye(3)
    column = outer[:, int(np.argmax(np.diag(outer)))]
    axis = column / np.linalg.norm(column)
    sign = -1.0 if axis @ sine_axis < 0.0 else 1.0
    return np.asarray(sign * math.atan2(sine, cosine) * axis)


def as_step(T: NDArray[Any]) -> Float64:
    """Return a rigid transform as a step, float64 (6,): translation and rotation vector."""
    return np.concatenate([T[:3, 3], log_so3(T[:3, :3])])


def as_transform(step: NDArray[Any]) -> Float64:
    """Return the rigid transform (…, 4, 4) of each step (…, 6) (`as_step`)."""
    T = np.zeros((*step.shape[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = exp_so3(step[..., 3:]), step[..., :3], 1.0
    return T


def step_jacobian(xyz: NDArray[Any]) -> Float64:
    """Return Jacobian (N, 3, 6) of points (N, 3) for a step of their frame: ``[I | -hat(xyz)]``."""
    J = np.zeros((len(xyz), 3, 6))
    J[:, [0, 1, 2], [0, 1, 2]] = 1.0
    x, y, z = xyz.T
    J[:, 0, 4], J[:, 0, 5] = z, -y
    J[:, 1, 3], J[:, 1, 5] = -z, x
    J[:, 2, 3], J[:, 2, 4] = y, -x
    return J


def adjoint(T_a_b: NDArray[Any]) -> Float64:
    """Return (…, 6, 6) that turns a step in the axes of b into the same motion in a's."""
    R, t = T_a_b[..., :3, :3], T_a_b[..., :3, 3]
    matrix = np.zeros((*T_a_b.shape[:-2], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = R
    matrix[..., :3, 3:] = hat(t) @ R
    return matrix


def orthonormalise(T: NDArray[Any]) -> Float64:
    """Return the rigid transform nearest to ``T``: its rotation part is made orthonormal by SVD."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    U[:, -1] *= np.sign(np.linalg.det(U @ Vt))
    return make_transform(U @ Vt, T[:3, 3])


def check_rigid(name: str, T: Float64, where: Path | None = None) -> None:
    """Check a pose that is read from a run: one that is none would spoil or exhaust a map."""
    if not (
        T.shape == (4, 4)
        and np.isfinite(T).all()
        and np.abs(T[:3, 3]).max() <= FARTHEST_M
        and np.array_equal(T[3], [0, 0, 0, 1])
        and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), rtol=0, atol=_RIGID_TOLERANCE)
        and np.linalg.det(T[:3, :3]) > 0
    ):
        raise FormatError(
            f"{name} is not a rigid transform of a map",
            where=where,
            got=T.tolist(),
            expected=f"a rotation and at most {FARTHEST_M:g} m",
        )


def rotation_from_quaternion(xyzw: NDArray[Any]) -> Float64:
    """Return the rotation matrix (3, 3) of a quaternion (4,) of any nonzero norm."""
    x, y, z, w = np.asarray(xyzw, dtype=np.float64) / np.linalg.norm(xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: NDArray[Any]) -> Float64:
    """Return the unit quaternion (4,) of a rotation matrix, ``w ≥ 0``, accurate at all angles.

    Ref: Bar-Itzhack, New method for extracting the quaternion from a rotation matrix, 2000.
    """
    R = np.asarray(rotation, dtype=np.float64)
    K = np.zeros((4, 4))
    K[:3, :3] = R + R.T - np.trace(R) * np.eye(3)
    K[3, :3] = K[:3, 3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    K[3, 3] = np.trace(R)
    xyzw: Float64 = np.linalg.eigh(K)[1][:, -1]
    return -xyzw if xyzw[3] < 0 else xyzw


_OF_CAMERA: Final = np.diag([1.0, -1.0, -1.0, 1.0])
_OF_MAP: Final = np.array([[0.0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
T_YUP_FRAME: Final[Mapping[Frame, Float64]] = MappingProxyType(
    {"camera": _OF_CAMERA, "world": _OF_CAMERA, "map": _OF_MAP}
)
"""float64 (4, 4), from each frame to x right, y up and z backwards, the axes of glTF and MeshLab:
what a camera saw in front of it is in front of the viewer."""


def transform_cloud(cloud: PointCloud, T: NDArray[Any], *, frame: Frame) -> PointCloud:
    """Transform a cloud to another frame by ``T`` (4, 4); only positions and directions change."""
    of = {
        each.name: rotate(T, all_) for each, all_ in cloud.attributes if each.fused == "direction"
    }
    return replace(cloud, xyz=apply(T, cloud.xyz), frame=frame, **of)


def part_of(T: Float64, ratio: float) -> Float64:
    """A fraction or multiple of a motion (4, 4): rotation and translation in proportion."""
    if ratio == 1.0:
        return T
    return make_transform(exp_so3(ratio * log_so3(T[:3, :3])), ratio * T[:3, 3])


_LONGEST_GAP: Final = 20.0
"""In intervals: over a longer gap the motion is not extrapolated in time, but repeated once."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The last pose, and how the camera moved to it."""

    T_world_camera: Float64  # (4, 4), the last pose
    timestamp_s: float  # time of the last pose
    # float64 (4, 4), the motion to it
    T_before_camera: Float64 = field(default_factory=lambda: np.eye(4))
    interval_s: float = 0.0  # time that the motion took; 0 = not known

    @property
    def velocity(self) -> Float64:
        """(3,), metres per second in the axes of the last pose; 0 where times are not known."""
        if not self.interval_s > 0.0:
            return np.zeros(3)
        T = self.T_before_camera
        return np.asarray(T[:3, :3].T @ T[:3, 3] / self.interval_s)

    def predict(self, timestamp_s: float) -> Float64:
        """The pose (4, 4) at a time: with constant velocity, where times are known."""
        passed_s = timestamp_s - self.timestamp_s
        ratio = passed_s / self.interval_s if self.interval_s > 0.0 else 1.0
        if not 0.0 < ratio <= _LONGEST_GAP:
            ratio = 1.0
        return orthonormalise(self.T_world_camera @ part_of(self.T_before_camera, ratio))

    def moved(self, T_world_camera: Float64, timestamp_s: float) -> Motion:
        """The model after a measured pose, which gives a new motion."""
        motion = invert(self.T_world_camera) @ T_world_camera
        return Motion(T_world_camera, timestamp_s, motion, timestamp_s - self.timestamp_s)

    def drifted(self, timestamp_s: float) -> Motion:
        """The model after a frame without a measured pose: the same motion continues."""
        T = self.predict(timestamp_s)
        return Motion(T, timestamp_s, self.T_before_camera, self.interval_s)


_LEAST_INFORMATION: Final = 1e-4
"""Added along every direction, so that one that nothing fixes gets 100 m or rad, not infinity."""


def covariance_of(information: Float64) -> Float64:
    """The covariance (6, 6) of an information matrix (6, 6), which may be singular."""
    return np.asarray(np.linalg.inv(information + _LEAST_INFORMATION * np.eye(6)))


def step_covariance(sigma_m: float, sigma_deg: float) -> Float64:
    """The covariance (6, 6) of a step that is equally uncertain in all directions."""
    return np.diag(np.repeat([sigma_m**2, np.deg2rad(sigma_deg) ** 2], 3))


def distance_in_sigmas(step: Float64, covariance: Float64) -> float:
    """The length of a step (6,) in standard deviations (Mahalanobis distance)."""
    return float(np.sqrt(step @ np.linalg.solve(covariance, step)))
