"""Writes one drive in every supported layout."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from recon.core.values import RectifiedCamera, StereoPair
from recon.io.images.image import write_image
from recon.street.settings import StreetScene
from tests.scenery.film import film
from tests.scenery.kitti import projections

RATE_HZ = 10.0
EPOCH_S = 1_600_000_000
FRAMES = 11
CAMERA = RectifiedCamera(60.0, 31.5, 15.5, 31.5, 0.5, 64, 32)

Pairs = list[StereoPair]
Writer = Callable[[Pairs, RectifiedCamera, Path], Path]


def rendered(frames: int, **settings: Any) -> tuple[Pairs, RectifiedCamera]:
    """Grey pairs of a street, which every layout can store without loss."""
    drive = film(StreetScene(frames=frames, threads=1, **settings))
    grey = drive.taken(slice(None), partial(cv2.cvtColor, code=cv2.COLOR_RGB2GRAY))
    return grey.pairs, grey.calibration


def _rows(camera: RectifiedCamera) -> list[str]:
    return [" ".join(f"{v:.17g}" for v in P.ravel()) for P in projections(camera)]


def write_calib(folder: Path, camera: RectifiedCamera) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "calib.txt"
    path.write_text("".join(f"P{n}: {row}\n" for n, row in enumerate(_rows(camera))))
    return path


def stamp_ns(pair: StereoPair) -> int:
    return EPOCH_S * 10**9 + round(pair.timestamp_s * 1e9)


def write_images(pairs, camera, folder, name):
    """Write both images of each pair, under a name by side (0 = left), and ``calib.txt``."""
    for pair in pairs:
        for side, image in enumerate((pair.left, pair.right)):
            write_image(folder / f"{name(side, pair)}.png", image)
    if camera is not None:
        write_calib(folder, camera)
    return folder


def write_kitti(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    write_images(pairs, camera, folder, lambda side, pair: f"image_{side}/{pair.index:06d}")
    (folder / "times.txt").write_text("".join(f"{p.timestamp_s:.6e}\n" for p in pairs))
    return folder


def write_kitti_raw(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    drive, lines = folder / "2011_09_26_drive_0001_sync", []
    write_images(pairs, None, drive, lambda side, pair: f"image_0{side}/data/{pair.index:010d}")
    stamps = [f"2011-09-26 13:02:{25 + p.timestamp_s:012.9f}\n" for p in pairs]
    for number, row in enumerate(_rows(camera)):
        (drive / f"image_0{number}" / "timestamps.txt").write_text("".join(stamps))
        # The raw camera is another one: who takes its numbers gets nonsense.
        lines += [
            f"S_0{number}: 1392 512", f"K_0{number}: 900 0 690 0 900 250 0 0 1",
            f"D_0{number}: -0.3 0.1 0 0 0", f"R_0{number}: 1 0 0 0 1 0 0 0 1",
            f"T_0{number}: {-0.5 * number} 0 0",
            f"S_rect_0{number}: {camera.width_px} {camera.height_px}",
            f"R_rect_0{number}: 1 0 0 0 1 0 0 0 1", f"P_rect_0{number}: {row}",
        ]  # fmt: skip
    text = "calib_time: 09-Jan-2012 13:57:47\n" + "\n".join(lines) + "\n"
    (folder / "calib_cam_to_cam.txt").write_text(text)
    return drive


def write_euroc(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    write_images(pairs, None, folder, lambda n, pair: f"mav0/cam{n}/data/{stamp_ns(pair)}")
    rows = "".join(f"{stamp},{stamp}.png\n" for stamp in map(stamp_ns, pairs))
    for number, P in enumerate(projections(camera)):
        view = folder / "mav0" / f"cam{number}"
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


def write_tum(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    sides = ("left", "right")

    def stamp(pair: StereoPair) -> str:
        return f"{EPOCH_S + pair.timestamp_s:.6f}"

    write_images(pairs, camera, folder, lambda n, pair: f"{sides[n]}/{stamp(pair)}")
    for side in sides:
        lines = "".join(f"{stamp(pair)} {side}/{stamp(pair)}.png\n" for pair in pairs)
        (folder / f"{side}.txt").write_text("# timestamp filename\n" + lines)
    return folder


def write_folders(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    """Names without leading zeros: 10 comes after 9."""
    sides = ("left/left", "right/right")
    return write_images(pairs, camera, folder, lambda n, pair: f"{sides[n]}{pair.index}")


def write_stamped(pairs, camera, folder, late_us=2000, lonely=True):
    """Names are timestamps, the right ones are late, and each side has one unpaired image."""
    write_images(
        pairs, camera, folder, lambda n, pair: f"cam{n}/{stamp_ns(pair) // 1000 + n * late_us}"
    )
    if lonely:
        last_us = stamp_ns(pairs[-1]) // 1000
        write_image(folder / "cam0" / f"{last_us + 100_000}.png", pairs[0].left)
        write_image(folder / "cam1" / f"{last_us + 150_000}.png", pairs[0].right)
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


def write_side_by_side(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    write_calib(folder, camera)
    return write_video(folder / "both.mkv", [np.hstack([p.left, p.right]) for p in pairs])


def write_two_videos(pairs, camera, folder, end=".avi", fourcc="FFV1"):
    write_calib(folder, camera)
    write_video(folder / f"left{end}", [p.left for p in pairs], fourcc)
    write_video(folder / f"right{end}", [p.right for p in pairs], fourcc)
    return folder


def write_lossy_videos(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    return write_two_videos(pairs, camera, folder, ".mp4", "mp4v")
