"""Small rendered files that stand in for those that the pages name.

To make the blocks of a new page run, add to `STAND_INS` what they read: how a block mentions it,
and the function that writes it.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from recon.commands.config import load_config
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.geometry.se3 import invert, make_transform
from recon.core.values import PointCloud, Trajectory
from recon.core.values.board import parse_board
from recon.io.cameras.calibration import write_recon_calibration
from recon.io.images.disparity import write_pfm
from recon.io.images.image import write_image
from recon.io.models.ply import write_ply
from recon.io.trajectory import write_kitti_poses, write_tum
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetSettings
from tests.docs.blocks import ROOT
from tests.flow.test_newcomer import BOARD, photograph, take_images
from tests.scenery.boards import board_rig, place_boards, render_views
from tests.scenery.kitti import write_kitti
from tests.scenery.middlebury import CAMERA as SCENE_CAMERA
from tests.scenery.middlebury import write_scene
from tests.scenery.planes import slanted_pair
from tests.sources import drives
from tests.sources.bags import Recording, write_bag
from tests.stereo.match.test_foreign_matchers import install_plugin

SCENES = ("ArtL", "Jadeplant", "Pipes", "Teddy")
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


def true_path() -> Trajectory:
    return street().truth.trajectory


def lidar(path: Path) -> None:
    surface = street().truth.surface
    write_ply(path, PointCloud(xyz=np.asarray(surface.xyz, np.float32)))


def drive_with_truth(folder: Path) -> None:
    drive(folder)
    lidar(folder.parent / "lidar_map.ply")


def image(side: str, path: Path) -> None:
    write_image(path, getattr(next(iter(street())), side))


def network(path: Path) -> None:
    from tests.stereo.match.networks import write_matcher

    write_matcher(path)


def camchain(path: Path) -> None:
    camera = street().calibration
    values = {"f": camera.focal_px, "cx": camera.cx_px, "cy": camera.cy_px}
    values |= {"width": camera.width_px, "height": camera.height_px}
    one = CAMERA.format(**values)
    path.write_text(f"cam0:\n{one}cam1:\n{APART.format(x=-camera.baseline_m)}{one}")


def bag(path: Path) -> None:
    """Images, their cameras, and odometry of a body at the left camera."""
    pairs, camera = drives.rendered(10, width_px=256, height_px=96, focal_px=150.0)
    write_bag(pairs, camera, path.parent, Recording(kind="ros1", odometry=body_path(len(pairs))))


def body_path(frames: int) -> np.ndarray:
    """T_odom_base of the street's camera in body axes (x forward, y left, z up)."""
    T_base_camera = np.eye(4)
    T_base_camera[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    return T_base_camera @ true_path().T_world_camera[:frames] @ invert(T_base_camera)


def recording(folder: Path) -> None:
    """What `recon capture --calib` leaves; slow enough to be mapped by every second frame, and
    large enough for `recon live`, which matches at half size."""
    size = {"width_px": 320, "height_px": 120, "focal_px": 190.0}
    pairs, camera = drives.rendered(12, speed_m_per_frame=0.4, **size)
    for pair in pairs:
        for side in ("left", "right"):
            write_image(folder / side / f"{pair.index:06d}.png", getattr(pair, side))
    write_recon_calibration(folder / "calibration.yaml", camera)


def distances(path: Path) -> None:
    """A wall beside a free voxel, as `recon export --to esdf` writes them."""
    cells, distance_m = np.array([[0, 0, 0], [0, 0, 1]], np.int32), np.array([-0.1, 0.1], "f4")
    np.savez(path, shape=np.array([1, 1, 2]), cells=cells, distance_m=distance_m)


def path_of_truth(path: Path) -> None:
    """On the clock of the bag."""
    times_s = true_path().timestamps_s + drives.EPOCH_S
    write_tum(path, replace(true_path(), timestamps_s=times_s))


def survey(path: Path) -> None:
    """Positions of the recording above, which drives straight ahead at 10 Hz, to the north-east."""
    lines = (f"{n / 10} {5e5 + 0.24 * n} {5e6 + 0.32 * n} 100 0 0 0 1\n" for n in range(12))
    path.write_text("".join(lines))


def results(folder: Path) -> None:
    """Disparities of another program for the scenes below."""
    folder.mkdir(parents=True)
    for name in SCENES:
        write_pfm(folder / f"{name}.pfm", np.full((80, 120), 10.0, np.float32))


def finished_run(folder: Path, source: SyntheticSource | None = None) -> None:
    config = load_config(overrides=["audit.quick=false"])
    run_map(source or street(), config, MapOptions(audit=False, out=folder, mesh=False))


def run_elsewhere(folder: Path) -> None:
    """A run of another street; of two in one map, it stays apart."""
    settings = street().settings.model_copy(update={"seed": 1})
    finished_run(folder, SyntheticSource(settings, surface_range_m=30.0))


def plugin(site: Path) -> None:
    """The matcher of docs/walk-research.md, as pip would install it."""
    page = (ROOT / "docs" / "walk-research.md").read_text()
    (source,) = re.findall(r"```python\n([^`]*class BlockMatcher.*?)```", page, re.DOTALL)
    site.mkdir()
    points = {"block": "block_matcher:BlockMatcher"}
    install_plugin(site, "block-matcher", {"block_matcher.py": source}, points)


def odometry_plugin(module: Path) -> None:
    """That of the examples, as pip would install it."""
    module.parent.mkdir(exist_ok=True)
    source = (ROOT / "examples" / "03_own_odometry.py").read_text()
    points = {"icp": "own_odometry:IcpOdometry"}
    install_plugin(module.parent, "own-odometry", {module.name: source}, points, "odometries")


def scenes(folder: Path) -> None:
    """Those of the paper, in Middlebury's layout."""
    for number, name in enumerate(SCENES):
        pair = slanted_pair(SCENE_CAMERA, 1.5, (0.1 * number, -0.1), seed=number)
        write_scene(folder / name, pair)


def board_images(pattern: Path) -> None:
    """Twelve views of a board by both cameras, and one of a room."""
    take_images(pattern.parent, board_rig("radtan", 480, 360))
    for side in ("left", "right"):
        (pattern.parent / f"{side}_room.png").rename(pattern.parent / f"{side}.png")


def board_views() -> list[tuple[np.ndarray, np.ndarray]]:
    rig, board = board_rig("radtan", 480, 360), parse_board(BOARD)
    return render_views(rig, board, place_boards(rig, board, 12, seed=4))


def board_folders(left: Path) -> None:
    for number, pair in enumerate(board_views()):
        for side, image in zip(("left", "right"), pair, strict=True):
            write_image(left.parent / side / f"{number:02d}.png", image)


def drive_of_that_rig(folder: Path) -> None:
    """A few steps through a room, seen by the cameras that see the board."""
    rig = board_rig("radtan", 480, 360)
    for number in range(4):
        T_world_left = make_transform(np.eye(3), np.array([0.0, 0.0, 0.05 * number]))
        poses = {"left": T_world_left, "right": T_world_left @ invert(rig.T_right_left)}
        for side, T_world_camera in poses.items():
            image = photograph(getattr(rig, side), T_world_camera)
            write_image(folder / side / f"{number:02d}.png", image)


def board_videos(left: Path) -> None:
    """Each view stands still for a few frames."""
    views = [pair for pair in board_views() for _ in range(6)]
    drives.write_video(left, [pair[0] for pair in views], "mp4v")
    drives.write_video(left.with_name("right.mp4"), [pair[1] for pair in views], "mp4v")
    drives.write_video(left.with_name("both.mp4"), [np.hstack(pair) for pair in views], "mp4v")


def scene(folder: Path) -> None:
    scenes(folder.with_name(".scenes"))
    (folder.with_name(".scenes") / SCENES[0]).rename(folder)


def job_file(path: Path) -> None:
    """The first of the page."""
    page = (ROOT / "docs" / "many-drives.md").read_text()
    path.write_text(re.findall(r"```toml\n(.*?)```", page, re.DOTALL)[0])


@dataclass(frozen=True)
class StandIn:
    """A file or folder that a page needs."""

    mention: str  # what is in the text of a page that needs it
    write: Callable[[Path], None]
    #: Where, from the folder in which blocks run or from ``~``; None = as mentioned.
    path: str | None = None

    def place(self, folder: Path, home: Path) -> Path:
        name = self.path or self.mention
        return home / name[2:] if name.startswith("~/") else folder / name


STAND_INS = (
    StandIn('np.load("outputs/next/map/esdf.npz")', distances, "outputs/next/map/esdf.npz"),
    StandIn("im0.png", partial(image, "left")),
    StandIn("im1.png", partial(image, "right")),
    StandIn("left.png right.png --", partial(image, "left"), "left.png"),
    StandIn("left.png right.png --", partial(image, "right"), "right.png"),
    StandIn("calib.txt", lambda path: drives.write_calib(path.parent, street().calibration)),
    StandIn("disp0GT.pfm", lambda path: write_pfm(path, np.full((96, 256), 5.0, np.float32))),
    StandIn("left*.png", board_images),
    StandIn("left/ right/", board_folders, "left"),
    StandIn("board/left board/right", board_folders, "board/left"),
    StandIn("left.mp4", board_videos),
    StandIn("~/kitti/sequences/06", drive),
    StandIn("~/kitti/poses/06.txt", lambda path: write_kitti_poses(path, true_path())),
    StandIn("~/long", drive),
    StandIn("DRIVE", drive_with_truth),
    StandIn("recon audit drive --calib rig.yaml", drive_of_that_rig, "drive"),
    StandIn("recon map drive ", recording, "drive"),
    StandIn("drive.bag", bag),
    StandIn("camchain.yaml", camchain),
    StandIn("groundtruth.txt", path_of_truth),
    StandIn("gnss.txt", survey),
    StandIn("lidar.ply", lidar),
    StandIn("scan.ply", lidar),
    StandIn("~/MiddEval3/trainingQ", scenes),
    StandIn("MiddEval3/trainingQ", scenes),
    StandIn("results/mine", results),
    StandIn("results/baseline", results),
    StandIn("network.onnx", network),
    StandIn("pip install ./block-matcher", plugin, "site"),
    StandIn("pip install ./own-odometry", odometry_plugin, "site/own_odometry.py"),
    StandIn("rides/today", recording),
    StandIn("rides/long", drive),
    StandIn("drives/*", drive, "drives/monday"),
    StandIn("recon batch jobs.toml", scene, "scene"),
    StandIn("recon batch jobs.toml", job_file, "jobs.toml"),
    StandIn("outputs/monday outputs/friday --out outputs/week  #", finished_run, "outputs/monday"),
    StandIn("outputs/monday outputs/friday --out outputs/week  #", run_elsewhere, "outputs/friday"),
    StandIn(
        "recon occupancy outputs/kitti06 --resolution 0.1 --max", finished_run, "outputs/kitti06"
    ),
)


def prepare(page: str, folder: Path, home: Path) -> None:
    """Write what the blocks of a page mention."""
    for stand_in in STAND_INS:
        place = stand_in.place(folder, home)
        if stand_in.mention in page and not place.exists():
            place.parent.mkdir(parents=True, exist_ok=True)
            stand_in.write(place)
