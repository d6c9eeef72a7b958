"""Initial guesses: each camera alone from its views of the board, then both joined to a rig."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import exp_so3, invert, log_so3, make_transform
from recon.core.values import CameraIntrinsics
from recon.core.values.arrays import Float64
from recon.rig.calibrate.bundle import RigState, Sighting, View, solve, squared_errors
from recon.rig.calibrate.settings import CalibrationSettings
from recon.stereo.rectify.lens import rays_of

Size = tuple[int, int]

# Half fields of view that are tried for a fisheye lens.
_HALF_ANGLES: Final = tuple(math.radians(angle) for angle in (35, 45, 55, 65, 75, 85, 95, 110))
_COEFFICIENTS: Final = {"rational": 8, "fisheye": 4}
# Rounds of reweighting; outlying views stand out after two.
_REWEIGHTED: Final = 4


def calibrate_one(
    sightings: Sequence[Sighting], size: Size, settings: CalibrationSettings
) -> RigState:
    """Return the lens and board poses of one camera, with views that do not fit down-weighted."""
    views = [View(str(number), (seen,)) for number, seen in enumerate(sightings)]
    if settings.model == "fisheye":
        state = _guess_fisheye(sightings, size)
    else:
        camera = _guess_pinhole(sightings, size)
        count = _COEFFICIENTS.get(settings.model, 2 + settings.radial_terms)
        distortion = np.zeros(count)
        distortion[:2] = camera.distortion[:2]
        state = _with_poses(replace(camera, distortion=distortion), sightings)
    return solve_robustly(views, state)


def solve_robustly(views: Sequence[View], start: RigState) -> RigState:
    """Solve with each view weighted by how well it fits (Cauchy weights of its rms error)."""
    state, weights = start, np.ones(len(views))
    for _ in range(_REWEIGHTED):
        state, _ = solve(views, state, weights)
        errors = view_errors(views, state)
        scale = 2.0 * float(np.median(errors)) + 1e-6
        weights = 1.0 / (1.0 + (errors / scale) ** 2)
    return state


def view_errors(views: Sequence[View], state: RigState) -> Float64:
    """Return float64 (V,), rms reprojection error of each view, pixels."""
    sums, counts = squared_errors(views, state)
    return np.asarray(np.sqrt(sums.sum(axis=1) / counts.sum(axis=1)))


def join_cameras(left: RigState, right: RigState) -> RigState:
    """Return both cameras in one rig, with the median pose of the right camera over all views."""
    T_right_left = [
        T_right @ invert(T_left)
        for T_left, T_right in zip(left.T_rig_board, right.T_rig_board, strict=True)
    ]
    rotation = np.median([log_so3(T[:3, :3]) for T in T_right_left], axis=0)
    shift = np.median([T[:3, 3] for T in T_right_left], axis=0)
    T = make_transform(exp_so3(rotation), shift)
    cameras = (*left.cameras, *right.cameras)
    return RigState(cameras, (np.eye(4), T), left.T_rig_board)


def locate_board(camera: CameraIntrinsics, seen: Sighting) -> Float64:
    """Return float64 (4, 4), T_camera_board of one sighting."""
    rays = rays_of(camera, seen.pixels)
    known = np.isfinite(rays).all(axis=1)
    try:
        done, rotation, shift = cv2.solvePnP(
            seen.board_m[known], rays[known, :2], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error as error:
        raise CalibrationError("no pose of the board fits", got=error.err) from error
    if not done or not np.isfinite(shift).all():
        raise CalibrationError("no pose of the board fits")
    return make_transform(cv2.Rodrigues(rotation)[0], shift.ravel())


def _with_poses(camera: CameraIntrinsics, sightings: Sequence[Sighting]) -> RigState:
    poses = np.stack([locate_board(camera, seen) for seen in sightings])
    return RigState((camera,), (np.eye(4),), poses)


def _guess_pinhole(sightings: Sequence[Sighting], size: Size) -> CameraIntrinsics:
    """Return OpenCV's calibration: Zhang's closed form, refined with two radial terms."""
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    try:
        _, matrix, distortion, *_ = cv2.calibrateCamera(
            [seen.board_m.astype(np.float32) for seen in sightings],
            [seen.pixels.astype(np.float32) for seen in sightings],
            size,
            None,
            None,
            flags=flags,
        )
    except cv2.error as error:
        raise CalibrationError("views do not determine a camera", got=error.err) from error
    return CameraIntrinsics(matrix, np.array(distortion, dtype=np.float64).ravel(), *size)


def _guess_fisheye(sightings: Sequence[Sighting], size: Size) -> RigState:
    """Return the undistorted fisheye lens, of several fields of view, that fits the board best."""
    radius = math.hypot(*size) / 2
    guesses: list[tuple[float, int, RigState]] = []
    for angle in _HALF_ANGLES:
        matrix = np.array(
            [
                [radius / angle, 0, (size[0] - 1) / 2],
                [0, radius / angle, (size[1] - 1) / 2],
                [0, 0, 1],
            ]
        )
        camera = CameraIntrinsics(matrix, np.zeros(4), *size, "fisheye")
        try:
            state = _with_poses(camera, sightings)
        except CalibrationError:
            continue
        views = [View("", (seen,)) for seen in sightings]
        error = float(np.median(view_errors(views, state)))
        guesses.append((error if math.isfinite(error) else math.inf, len(guesses), state))
    if not guesses or math.isinf(min(guesses)[0]):
        raise CalibrationError("views do not determine a fisheye lens")
    return min(guesses)[2]
