"""Writes one drive in every supported layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from recon.core.values import RectifiedCamera, StereoPair
from recon.io.images.image import write_image
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene

RATE_HZ = 10.0
EPOCH_S = 1_600_000_000
FRAMES = 11
CAMERA = RectifiedCamera(60.0, 31.5, 15.5, 31.5, 0.5, 64, 32)

Writer = Callable[[list[StereoPair], RectifiedCamera, Path], Path]


def rendered(frames: int, **settings: Any) -> tuple[list[StereoPair], RectifiedCamera]:
    """Grey pairs of a street, which every layout can store without loss."""
    source = SyntheticSource(StreetScene(frames=frames, threads=1, **settings))
    grey = [
        StereoPair(
            *(np.asarray(cv2.cvtColor(p, cv2.COLOR_RGB2GRAY)) for p in (pair.left, pair.right)),
            pair.timestamp_s,
            pair.index,
            pair.name,
        )
        for pair in source
    ]
    return grey, source.calibration


def projections(camera: RectifiedCamera) -> tuple[np.ndarray, np.ndarray]:
    left = np.hstack([camera.matrix, np.zeros((3, 1))])
    right = left.copy()
    right[0, 2] = camera.cx_right_px
    right[0, 3] = -camera.focal_px * camera.baseline_m
    return left, right


def write_calib(folder: Path, camera: RectifiedCamera) -> Path:
    rows = [" ".join(f"{v:.17g}" for v in P.ravel()) for P in projections(camera)]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "calib.txt"
    path.write_text("".join(f"P{n}: {row}\n" for n, row in enumerate(rows)))
    return path


def write_kitti(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    for pair in pairs:
        write_image(folder / "image_0" / f"{pair.index:06d}.png", pair.left)
        write_image(folder / "image_1" / f"{pair.index:06d}.png", pair.right)
    write_calib(folder, camera)
    (folder / "times.txt").write_text("".join(f"{p.timestamp_s:.6e}\n" for p in pairs))
    return folder


def write_kitti_raw(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    drive = folder / "2011_09_26_drive_0001_sync"
    size = f"{camera.width_px} {camera.height_px}"
    lines = []
    for number, P in enumerate(projections(camera)):
        view = drive / f"image_0{number}"
        for pair in pairs:
            image = (pair.left, pair.right)[number]
            write_image(view / "data" / f"{pair.index:010d}.png", image)
        stamps = [f"2011-09-26 13:02:{25 + p.timestamp_s:012.9f}\n" for p in pairs]
        (view / "timestamps.txt").write_text("".join(stamps))
        row = " ".join(f"{v:.17g}" for v in P.ravel())
        # The raw camera is another one: who takes its numbers gets nonsense.
        lines += [
            f"S_0{number}: 1392 512", f"K_0{number}: 900 0 690 0 900 250 0 0 1",
            f"D_0{number}: -0.3 0.1 0 0 0", f"R_0{number}: 1 0 0 0 1 0 0 0 1",
            f"T_0{number}: {-0.5 * number} 0 0", f"S_rect_0{number}: {size}",
            f"R_rect_0{number}: 1 0 0 0 1 0 0 0 1", f"P_rect_0{number}: {row}",
        ]  # fmt: skip
    (folder / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\n" + "\n".join(lines) + "\n"
    )
    return drive


def write_euroc(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    for number, P in enumerate(projections(camera)):
        view = folder / "mav0" / f"cam{number}"
        stamps = [EPOCH_S * 10**9 + round(p.timestamp_s * 1e9) for p in pairs]
        for stamp, pair in zip(stamps, pairs, strict=True):
            write_image(view / "data" / f"{stamp}.png", (pair.left, pair.right)[number])
        rows = "".join(f"{stamp},{stamp}.png\n" for stamp in stamps)
        (view / "data.csv").write_text("#timestamp [ns],filename\n" + rows)
        # The body is turned against the cameras: x forward, z up.
        T_body_cam = np.eye(4)
        T_body_cam[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
        T_body_cam[1, 3] = -number * camera.baseline_m
        content = {
            "sensor_type": "camera",
            "T_BS": {"cols": 4, "rows": 4, "data": T_body_cam.ravel().tolist()},
            "rate_hz": 10,
            "resolution": [camera.width_px, camera.height_px],
            "camera_model": "pinhole",
            "intrinsics": [float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2])],
            "distortion_model": "radial-tangential",
            "distortion_coefficients": [0.0, 0.0, 0.0, 0.0],
        }
        (view / "sensor.yaml").write_text("#Camera\n" + yaml.safe_dump(content))
    return folder


def write_tum(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    for number, side in enumerate(("left", "right")):
        lines = ["# timestamp filename\n"]
        for pair in pairs:
            name = f"{side}/{EPOCH_S + pair.timestamp_s:.6f}.png"
            write_image(folder / name, (pair.left, pair.right)[number])
            lines.append(f"{EPOCH_S + pair.timestamp_s:.6f} {name}\n")
        (folder / f"{side}.txt").write_text("".join(lines))
    write_calib(folder, camera)
    return folder


def write_folders(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    """Names without leading zeros: 10 comes after 9."""
    for pair in pairs:
        write_image(folder / "left" / f"left{pair.index}.png", pair.left)
        write_image(folder / "right" / f"right{pair.index}.png", pair.right)
    write_calib(folder, camera)
    return folder


def write_stamped(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    """Names are timestamps, the right ones 2 ms late, and each side has one unpaired image."""
    for pair in pairs:
        stamp_us = round((EPOCH_S + pair.timestamp_s) * 1e6)
        write_image(folder / "cam0" / f"{stamp_us}.png", pair.left)
        write_image(folder / "cam1" / f"{stamp_us + 2000}.png", pair.right)
    lonely = round((EPOCH_S + pairs[-1].timestamp_s) * 1e6)
    write_image(folder / "cam0" / f"{lonely + 100_000}.png", pairs[0].left)
    write_image(folder / "cam1" / f"{lonely + 150_000}.png", pairs[0].right)
    write_calib(folder, camera)
    return folder


def write_video(path: Path, images: list[np.ndarray], fourcc: str = "FFV1") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = images[0].shape[:2]
    code = cv2.VideoWriter.fourcc(*fourcc)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, RATE_HZ, (width, height))
    assert writer.isOpened()
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def write_side_by_side(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    write_calib(folder, camera)
    return write_video(folder / "both.mkv", [np.hstack([p.left, p.right]) for p in pairs])


def write_two_videos(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    write_calib(folder, camera)
    write_video(folder / "left.avi", [p.left for p in pairs])
    write_video(folder / "right.avi", [p.right for p in pairs])
    return folder


def write_lossy_videos(pairs: list[StereoPair], camera: RectifiedCamera, folder: Path) -> Path:
    write_calib(folder, camera)
    write_video(folder / "left.mp4", [p.left for p in pairs], "mp4v")
    write_video(folder / "right.mp4", [p.right for p in pairs], "mp4v")
    return folder
