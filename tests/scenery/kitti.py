"""A rendered drive as files in the layout of KITTI."""

from pathlib import Path
from typing import Any

import numpy as np

from recon.core.values import RectifiedCamera
from recon.core.values.arrays import UInt8
from recon.io.atomic import write_text
from recon.io.files import StrPath
from recon.io.images.image import write_image
from recon.io.trajectory import write_kitti_poses
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.film import Film

_BT601 = np.array([0.299, 0.587, 0.114])


def write_kitti(source: SyntheticSource | Film, folder: StrPath, *, grey: bool = True) -> None:
    """Write a drive as a KITTI odometry sequence, with its grey images or without."""
    target = Path(folder)
    for pair in source:
        name = f"{pair.index:06d}.png"
        for camera, image in enumerate((pair.left, pair.right)):
            write_image(target / f"image_{camera + 2}" / name, image)
            if grey:
                write_image(target / f"image_{camera}" / name, _grey(image))
    write_text(target / "calib.txt", _calibration_text(source.calibration))
    times = source.trajectory.timestamps_s
    write_text(target / "times.txt", "".join(f"{time_s:.6e}\n" for time_s in times))
    write_kitti_poses(target / "poses.txt", source.trajectory)


def street_drive(folder: Path, frames: int, width_px: int = 256, **street: Any) -> Path:
    """Render a street, and write the drive through it; from 256 px on, every pose is trusted."""
    size = {"width_px": width_px, "height_px": width_px * 3 // 8, "focal_px": width_px * 150 / 256}
    scene = StreetScene(frames=frames, **{**size, "smooth_edges": False, **street})
    write_kitti(SyntheticSource(scene), folder)
    return folder


def _grey(image: UInt8) -> UInt8:
    return np.asarray(np.rint(image @ _BT601), dtype=np.uint8)


def projections(camera: RectifiedCamera) -> tuple[np.ndarray, np.ndarray]:
    """Projection matrices (3, 4) of the left and the right camera."""
    left = np.hstack([camera.matrix, np.zeros((3, 1))])
    right = left.copy()
    right[0, 2] = camera.cx_right_px
    right[0, 3] = -camera.focal_px * camera.baseline_m
    return left, right


def _calibration_text(camera: RectifiedCamera) -> str:
    """P0 and P2 of the left, P1 and P3 of the right camera; grey and colour coincide."""
    rows = (" ".join(f"{value:.12e}" for value in P.ravel()) for P in 2 * projections(camera))
    return "".join(f"P{number}: {row}\n" for number, row in enumerate(rows))
