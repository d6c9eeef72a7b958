"""Writes a rendered drive as a folder of TUM's RGB-D benchmark, with its true depth."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from recon.io.images.image import write_image
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene

PER_METRE = 1000.0  # a street is farther than the 13 m of TUM's 5000
LATE_S = 0.004  # of depth: both cameras run freely


def levels_of(depth_m: np.ndarray, per_metre: float = PER_METRE) -> np.ndarray:
    """Depth in 16 bits; what is unknown, or too far for 16 bits, is 0."""
    levels = np.rint(np.nan_to_num(depth_m) * per_metre)
    return np.where(levels < 2**16, levels, 0).astype(np.uint16)


def write_rgbd(source: SyntheticSource, folder: Path) -> Path:
    lists = {"rgb": [], "depth": [], "groundtruth": []}
    for index in range(len(source)):
        frame = source.frame(index)
        time_s, T = 100.0 + frame.pair.timestamp_s, frame.T_world_camera
        images = {"rgb": (time_s, frame.pair.left)}
        images["depth"] = (time_s + LATE_S, levels_of(frame.depth_m))
        for name, (stamp_s, image) in images.items():
            file = f"{name}/{stamp_s:.6f}.png"
            write_image(folder / file, image)
            lists[name].append(f"{stamp_s:.6f} {file}")
        pose = (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat())
        lists["groundtruth"].append(f"{time_s:.6f} " + " ".join(f"{x:.9f}" for x in pose))
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("# of a rendered drive\n" + "\n".join(lines) + "\n")
    return folder


def street(frames: int, width_px: int = 256) -> SyntheticSource:
    size = {"width_px": width_px, "height_px": width_px * 3 // 8, "focal_px": width_px * 150 / 256}
    return SyntheticSource(StreetScene(frames=frames, **size, smooth_edges=False))
