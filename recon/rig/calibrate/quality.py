"""Quality of the views of a calibration: image coverage and tilt of the board."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from recon.core.values import CameraIntrinsics
from recon.core.values.arrays import Float64
from recon.rig.calibrate.bundle import View
from recon.rig.calibrate.stereo import StereoFit

# Image cells, 8 by 6: in a cell without corners, the lens model is extrapolated.
_CELLS: Final = (8, 6)


def shared_pixels(view: View) -> tuple[Float64, Float64]:
    """float64 (N, 2) twice: the corners that both cameras saw, in the left and right image."""
    left, right = view.seen
    _, of_left, of_right = np.intersect1d(left.numbers, right.numbers, return_indices=True)
    return left.pixels[of_left], right.pixels[of_right]


def coverage(pixels: Sequence[Float64], camera: CameraIntrinsics) -> float:
    """Return the share of the 8 by 6 image cells in which a corner was seen, in [0, 1].

    Args:
        pixels: float64 (N, 2) for each view.
        camera: The camera.
    """
    size = np.array([camera.width_px, camera.height_px])
    cells = np.floor((np.concatenate(pixels) + 0.5) / size * _CELLS).astype(int)
    inside = np.clip(cells, 0, np.array(_CELLS) - 1)
    return len(np.unique(inside, axis=0)) / (_CELLS[0] * _CELLS[1])


def tilt_deg(fit: StereoFit) -> Float64:
    """Return float64 (V,), angle between the board's normal and the left camera's optical axis."""
    normals = np.array([T[2, 2] for T in fit.state.T_rig_board])
    return np.asarray(np.degrees(np.arccos(np.clip(np.abs(normals), 0.0, 1.0))))


def distances_m(fit: StereoFit) -> Float64:
    """Return float64 (V,), distance of the middle of the board from the left camera."""
    middles = [
        (T @ [*view.seen[0].board_m.mean(axis=0), 1.0])[:3]
        for T, view in zip(fit.state.T_rig_board, fit.views, strict=True)
    ]
    return np.asarray(np.linalg.norm(middles, axis=1))
