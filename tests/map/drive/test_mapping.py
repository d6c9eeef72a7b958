"""A drive in the map: a real street, poses that are doubted, and matching behind the poses."""

from __future__ import annotations

from pathlib import Path
from threading import Event

import cv2
import numpy as np
import pytest

from recon.core.errors import MappingError, RegistrationError
from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.core.values import FREE, OCCUPIED, PointCloud, RectifiedCamera, RectifiedPair, Trajectory
from recon.core.values.arrays import Float64
from recon.map.drive.drive import MapBehind
from recon.map.drive.drive_odometry import doubt_poses
from recon.map.fusion import CloudBuilder, FusionSettings
from recon.map.ground.axes import AxesSettings, estimate_ground, map_axes
from recon.map.ground.grid import GridSettings, flatten
from recon.map.ground.surface import GroundSettings, estimate_ground_surface
from recon.map.occupancy.builder import OccupancyBuilder, OccupancySettings
from recon.map.settings import DriveSettings
from recon.odometry.protocol import OdometryHealth, OdometryResult
from recon.street.settings import StreetScene
from tests.scenery.film import RIG, Film, film
from tests.scenery.patience import LONG_S

FRAMES = range(0, 36, 2)


def _poses(drive: Path) -> np.ndarray:
    rows = np.loadtxt(drive / "poses.txt").reshape(-1, 3, 4)
    bottom = np.tile([[0.0, 0.0, 0.0, 1.0]], (len(rows), 1, 1))
    return np.concatenate([rows, bottom], axis=1)


def _cloud(drive: Path, index: int) -> PointCloud:
    """A frame by OpenCV's matcher: these tests need no matcher of ours."""
    left, right = (
        cv2.imread(str(sorted((drive / side).glob("*.png"))[index]), cv2.IMREAD_GRAYSCALE)
        for side in ("image_0", "image_1")
    )
    lines = (drive / "calib.txt").read_text().splitlines()
    P1 = next(np.array(line.split()[1:], float) for line in lines if line.startswith("P1:"))
    f, cx, cy, b = P1[0], P1[2], P1[6], -P1[3] / P1[0]
    matcher = cv2.StereoSGBM_create(
        numDisparities=96, blockSize=5, P1=200, P2=800, disp12MaxDiff=1, uniquenessRatio=10,
        speckleWindowSize=100, speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = matcher.compute(left, right).astype(np.float32) / 16
    v, u = np.nonzero(disparity > f * b / 40)
    z = f * b / disparity[v, u]
    xyz = np.stack([(u - cx) * z / f, (v - cy) * z / f, z], axis=1).astype(np.float32)
    return PointCloud(xyz, sigma_m=(0.4 * z**2 / (f * b)).astype(np.float32))


@pytest.mark.real
@pytest.mark.slow
def test_the_driven_road_is_free_and_has_obstacles_beside_it(recon_data: Path) -> None:
    drive = recon_data / "driven" / "kitti_06_51"
    poses = _poses(drive)[FRAMES]
    clouds = [_cloud(drive, index) for index in FRAMES]
    T_map_world = map_axes(estimate_ground(clouds[0]), AxesSettings())
    fused = CloudBuilder(FusionSettings())
    occupancy = OccupancyBuilder(OccupancySettings(), T_map_world)
    for cloud, T in zip(clouds, poses, strict=True):
        world = PointCloud(apply(T, cloud.xyz), sigma_m=cloud.sigma_m, frame="world")
        fused.integrate(world)
        occupancy.integrate(cloud, T)
    path = apply(T_map_world, poses[:, :3, 3])
    cloud_map = PointCloud(apply(T_map_world, fused.part().cloud(0.1, 2).xyz), frame="map")
    ground = estimate_ground_surface(cloud_map, path, GroundSettings())
    grid = flatten(occupancy.voxels(), ground, GridSettings())
    # KITTI's cameras are mounted 1.65 m above ground.
    assert 1.55 < ground.camera_height_m < 1.75
    # The lane, 2 m wide; the first metres lie below the image and are never seen.
    driven = path[path[:, 0] > 8]
    lane = np.concatenate(
        [driven + np.array([0.0, side, 0.0]) for side in np.arange(-1.0, 1.1, 0.2)]
    )
    column, row = ((lane[:, :2] - grid.origin_m) / grid.resolution_m).astype(int).T
    assert (grid.cells[row, column] == FREE).all()
    # Parked cars and poles: some of the area, not most of it.
    share = (grid.cells == OCCUPIED).sum() / (grid.cells != -1).sum()
    assert 0.005 < share < 0.15


T_BODY_CAMERA = make_transform(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3)
)
T_SURVEY_WORLD = make_transform(exp_so3(np.array([0.0, 2.0, 0.0])), np.array([4e5, 5e6, 100.0]))


def doubts(film: Film, poses: Float64) -> tuple[str, ...]:
    # Poses in KITTI's format have no times; those of the images are another matter.
    known = Trajectory(poses, np.arange(len(poses), dtype=np.float64))
    return doubt_poses(known, film, DriveSettings())


@pytest.fixture(scope="module")
def street() -> Film:
    return film(StreetScene(frames=8, seed=1, **RIG))


@pytest.mark.parametrize("T_there_world", [np.eye(4), T_SURVEY_WORLD])
def test_right_poses_are_not_doubted(street: Film, T_there_world: Float64) -> None:
    assert doubts(street, T_there_world @ street.trajectory.T_world_camera) == ()
    assert doubts(street.taken(slice(0, 1)), np.eye(4)[None]) == ()
    with pytest.raises(RegistrationError, match="fewer known poses than frames"):
        doubts(street, street.trajectory.T_world_camera[:5])


def scaled(poses: Float64) -> Float64:
    poses = poses.copy()
    poses[:, :3, 3] *= 1.5
    return poses


@pytest.mark.parametrize("change", [scaled, invert, lambda poses: poses[::-1].copy()])
def test_poses_that_contradict_the_images_are_doubted(street: Film, change) -> None:
    (line,) = doubts(street, change(street.trajectory.T_world_camera))
    assert "contradict what the cameras see" in line
    assert "standard deviations off" in line


def test_poses_of_a_body_are_recognised(street: Film) -> None:
    poses = T_BODY_CAMERA @ street.trajectory.T_world_camera @ invert(T_BODY_CAMERA)
    (line,) = doubts(street, poses)
    assert "as those of a body" in line


GREY = np.zeros((16, 16), np.uint8)
CAMERA = RectifiedCamera(10.0, 8.0, 8.0, 8.0, 0.5, 16, 16)


class Counted:
    """What a live source tells of itself."""

    unmatched = 0

    def note_unmatched(self) -> None:
        self.unmatched += 1


class Mapper:
    """Maps a frame when it may, and notes which was matched."""

    def __init__(self) -> None:
        self.done: list[tuple[int, bool]] = []
        self.begun, self.go = Event(), Event()

    def __call__(self, pair: RectifiedPair, result: OdometryResult, matched: bool) -> None:
        self.begun.set()
        self.go.wait(LONG_S)
        self.done.append((pair.index, matched))


def _frame(index: int) -> tuple[RectifiedPair, OdometryResult]:
    pair = RectifiedPair(GREY, GREY, CAMERA, index=index)
    return pair, OdometryResult(np.eye(4), OdometryHealth())


def test_of_frames_that_wait_the_newest_is_matched() -> None:
    source, mapper = Counted(), Mapper()
    behind = MapBehind(source, mapper)
    behind.add(_frame(0))
    mapper.begun.wait(LONG_S)
    for index in range(1, 5):
        behind.add(_frame(index))

    mapper.go.set()
    behind.wait()
    behind.stop()

    assert mapper.done == [(0, True), (1, False), (2, False), (3, False), (4, True)]
    assert source.unmatched == 3


def test_the_first_frame_is_matched_however_late_it_is() -> None:
    source, mapper = Counted(), Mapper()
    mapper.go.set()
    behind = MapBehind(source, mapper)
    with behind._news:
        behind._waiting.extend(_frame(index) for index in range(3))
        behind._news.notify_all()

    behind.wait()
    behind.stop()

    assert mapper.done == [(0, True), (1, False), (2, True)]


def test_what_goes_wrong_is_raised_where_frames_are_added() -> None:
    def fail(*_: object) -> None:
        begun.set()
        raise MappingError("no")

    begun = Event()
    behind = MapBehind(Counted(), fail)
    with behind._news:
        behind._waiting.append(_frame(0))
        behind._news.notify_all()
    begun.wait(LONG_S)

    with pytest.raises(MappingError, match="no"):
        behind.wait()
    with pytest.raises(MappingError, match="no"):
        behind.add(_frame(1))
    behind.stop()
