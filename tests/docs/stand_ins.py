"""Small rendered files that stand in for those that the pages name.

To make the blocks of a new page run, name here what they read: the key is what a block calls it,
``~`` is the home folder, and the function writes it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from recon.formats.image import write_image
from recon.formats.ply import write_ply
from recon.sources.synthetic import SyntheticSource, write_kitti
from recon.structures import PointCloud, RectifiedCamera
from recon.structures.board import parse_board
from recon.synthetic.boards import board_rig, place_boards, render_views
from recon.synthetic.planes import slanted_pair, step_pair
from recon.synthetic.settings import StreetSettings
from tests.flow.test_newcomer import BOARD, take_pictures
from tests.flow.test_paper import write_scene
from tests.sources import drives

CAMERA = """  camera_model: pinhole
  intrinsics: [{f}, {f}, {cx}, {cy}]
  distortion_model: radtan
  distortion_coeffs: [0, 0, 0, 0]
  resolution: [{width}, {height}]
"""
APART = "  T_cn_cnm1: [[1, 0, 0, {x}], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"


@cache
def street() -> SyntheticSource:
    """Twelve frames: long enough for odometry and for segments of five metres."""
    settings = StreetSettings(frames=12, width_px=256, height_px=96, focal_px=150.0)
    return SyntheticSource(settings, surface_range_m=30.0)


def drive(folder: Path) -> None:
    write_kitti(street(), folder)


def lidar(path: Path) -> None:
    """The true surface of the street."""
    truth = street().truth
    assert truth is not None
    assert truth.surface is not None
    write_ply(path, PointCloud(xyz=np.asarray(truth.surface.xyz, np.float32)))


def poses(path: Path) -> None:
    folder = path.parent / ".drive"
    write_kitti(street(), folder, grey=False)
    shutil.copyfile(folder / "poses.txt", path)
    shutil.rmtree(folder)


def drive_with_truth(folder: Path) -> None:
    drive(folder)
    lidar(folder.parent / "lidar_map.ply")


def image(number: int) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        pair = next(iter(street()))
        write_image(path, pair.right if number else pair.left)

    return write


def kitti_calibration(path: Path) -> None:
    """Without the size of the images, which KITTI's do not have."""
    drives.write_calib(path.parent, street().calibration)


def camchain(path: Path) -> None:
    camera = street().calibration
    values = {"f": camera.focal_px, "cx": camera.cx_px, "cy": camera.cy_px}
    values |= {"width": camera.width_px, "height": camera.height_px}
    one = CAMERA.format(**values)
    path.write_text(f"cam0:\n{one}cam1:\n{APART.format(x=-camera.baseline_m)}{one}")


def bag(path: Path) -> None:
    from tests.sources.bags import Recording, write_bag

    pairs, camera = drives.rendered(8, width_px=256, height_px=96, focal_px=150.0)
    write_bag(pairs, camera, path.parent, Recording(kind="ros1"))


def recording(folder: Path) -> None:
    """What `recon capture` leaves."""
    pairs, camera = drives.rendered(8, width_px=256, height_px=96, focal_px=150.0)
    drives.write_folders(pairs, camera, folder)


def scenes(folder: Path) -> None:
    """Those of the paper, in Middlebury's layout."""
    camera = RectifiedCamera(180.0, 55.0, 40.0, 65.0, 0.2, 120, 80, 24)
    write_scene(folder / "ArtL", step_pair(camera, 1.3, 2.0, 20.0, seed=1))
    write_scene(folder / "Jadeplant", slanted_pair(camera, 1.6, (0.3, 0.0), seed=2))
    write_scene(folder / "Pipes", slanted_pair(camera, 1.5, (0.0, -0.2), seed=3))


def board_images(pattern: Path) -> None:
    """Twelve views of a board by both cameras, and one of a room."""
    take_pictures(pattern.parent, board_rig("radtan", 480, 360))
    for side in ("left", "right"):
        (pattern.parent / f"{side}_room.png").rename(pattern.parent / f"{side}.png")


def board_views() -> list[tuple[np.ndarray, np.ndarray]]:
    rig, board = board_rig("radtan", 480, 360), parse_board(BOARD)
    return render_views(rig, board, place_boards(rig, board, 12, seed=4))


def board_folders(left: Path) -> None:
    for number, pair in enumerate(board_views()):
        for side, picture in zip(("left", "right"), pair, strict=True):
            write_image(left.parent / side / f"{number:02d}.png", picture)


def board_videos(left: Path) -> None:
    """Each view stands still for a few frames."""
    views = [pair for pair in board_views() for _ in range(6)]
    drives.write_video(left, [pair[0] for pair in views], "mp4v")
    drives.write_video(left.with_name("right.mp4"), [pair[1] for pair in views], "mp4v")
    drives.write_video(left.with_name("both.mp4"), [np.hstack(pair) for pair in views], "mp4v")


STAND_INS: dict[str, Callable[[Path], None]] = {
    "im0.png": image(0),
    "im1.png": image(1),
    "calib.txt": kitti_calibration,
    "left*.png": board_images,
    "left/ right/": board_folders,
    "left.mp4": board_videos,
    "~/kitti/sequences/06": drive,
    "~/kitti/poses/06.txt": poses,
    "~/long": drive,
    "DRIVE": drive_with_truth,
    "drive.bag": bag,
    "camchain.yaml": camchain,
    "lidar.ply": lidar,
    "~/MiddEval3/trainingQ": scenes,
    "MiddEval3/trainingQ": scenes,
    "rides/today": recording,
    "drive --calib": recording,
}


def prepare(page: str, folder: Path, home: Path) -> None:
    """Write what the blocks of a page name."""
    for name, write in STAND_INS.items():
        if name in page:
            place = home / name[2:] if name.startswith("~/") else folder / name.split()[0]
            place.parent.mkdir(parents=True, exist_ok=True)
            write(place)
