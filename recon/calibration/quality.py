"""What a calibration is worth, apart from how well it fits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from recon.calibration.bundle import View
from recon.calibration.stereo import StereoFit
from recon.structures import CameraIntrinsics
from recon.structures.arrays import Float64

# The picture in 8 by 6 cells: where no corner ever was, a lens is guessed.
_CELLS: Final = (8, 6)


def shared_pixels(view: View) -> tuple[Float64, Float64]:
    """float64 (N, 2) twice: the corners that both cameras saw, in the left and right picture."""
    left, right = view.seen
    _, of_left, of_right = np.intersect1d(left.numbers, right.numbers, return_indices=True)
    return left.pixels[of_left], right.pixels[of_right]


def coverage(pixels: Sequence[Float64], camera: CameraIntrinsics) -> float:
    """Share of 8 by 6 cells of the picture in which a corner was seen, in [0, 1].

    Args:
        pixels: float64 (N, 2) for each view.
        camera: The camera.
    """
    size = np.array([camera.width_px, camera.height_px])
    cells = np.floor((np.concatenate(pixels) + 0.5) / size * _CELLS).astype(int)
    inside = np.clip(cells, 0, np.array(_CELLS) - 1)
    return len(np.unique(inside, axis=0)) / (_CELLS[0] * _CELLS[1])


def tilt_deg(fit: StereoFit) -> Float64:
    """float64 (V,), how far the board leant away from facing the left camera's axis."""
    normals = np.array([T[2, 2] for T in fit.state.T_rig_board])
    return np.asarray(np.degrees(np.arccos(np.clip(np.abs(normals), 0.0, 1.0))))
