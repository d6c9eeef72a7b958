"""Ground truth trajectories, interpolated to the timestamps of the images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.core.geometry.interpolation import interpolate_poses
from recon.core.geometry.se3 import invert
from recon.core.values import SequenceTruth, Trajectory
from recon.core.values.arrays import Float64
from recon.io.trajectory import read_tum


def truth_at(
    path: Trajectory, stamps_s: Float64, T_body_camera: Float64 | None = None
) -> tuple[SequenceTruth | None, str]:
    """Return True pose of the left camera in each frame; the first one is the identity.

    Args:
        path: ``T_world_body`` at the times of the measuring instrument.
        stamps_s: float64 (N,), times of the frames.
        T_body_camera: float64 (4, 4), pose of the left camera in the body; None = identity.

    Returns:
        The ground truth and an empty note, or None and a note if it does not cover every frame.
    """
    covered = (stamps_s >= path.timestamps_s[0]) & (stamps_s <= path.timestamps_s[-1])
    if not covered.all():
        return None, f", ground truth for only {covered.sum()} of {len(stamps_s)} frames: not used"
    poses = interpolate_poses(path, stamps_s)
    if T_body_camera is not None:
        poses = poses @ T_body_camera
    return SequenceTruth(Trajectory(invert(poses[0]) @ poses, stamps_s)), ""


def read_tum_truth(folder: Path, stamps_s: Float64) -> tuple[SequenceTruth | None, str]:
    """Return ground truth from ``groundtruth.txt`` (TUM format, left camera), if a folder has one.

    Raises:
        FormatError: The file is damaged.
    """
    path = folder / "groundtruth.txt"
    if not path.is_file():
        return None, ""
    return truth_at(read_tum(path), np.asarray(stamps_s))
