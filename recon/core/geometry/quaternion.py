"""Unit quaternions (x, y, z, w), in the order of TUM files and ROS, and rotation matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Float64


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
    """Return the unit quaternion (4,) of a rotation matrix (3, 3), with ``w ≥ 0``.

    The eigenvector method used is accurate at all angles; the formula based on the trace divides
    by almost zero near 180 degrees.

    Ref: Bar-Itzhack, New method for extracting the quaternion from a rotation matrix, 2000.
    """
    R = np.asarray(rotation, dtype=np.float64)
    K = np.zeros((4, 4))
    K[:3, :3] = R + R.T - np.trace(R) * np.eye(3)
    K[3, :3] = K[:3, 3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    K[3, 3] = np.trace(R)
    xyzw: Float64 = np.linalg.eigh(K)[1][:, -1]
    return -xyzw if xyzw[3] < 0 else xyzw
