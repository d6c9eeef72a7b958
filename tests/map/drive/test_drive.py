"""A drive in the map: poses that are doubted, matching behind poses, and loops."""

import math
import time
from threading import Event
from unittest.mock import patch

import cv2
import numpy as np
import pytest

from recon.core.errors import MappingError, RegistrationError
from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import Disparity, PointCloud, RectifiedCamera, RectifiedPair, Trajectory
from recon.core.values.arrays import Float64
from recon.map.drive import drive_loops
from recon.map.drive.drive import MapBehind
from recon.map.drive.drive_loops import DriveLoops, LoopWatch
from recon.map.drive.drive_odometry import doubt_poses
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.settings import DriveSettings
from recon.map.store.records import Store
from recon.map.store.session import Keyframes
from recon.odometry.protocol import OdometryHealth, OdometryResult
from recon.places import places
from recon.places.closure import DrivePath, close_loops
from recon.places.detector import CONTRADICTED, LoopDetector
from recon.stereo.frame import ReconstructedFrame
from recon.street.settings import StreetScene
from tests.run.pools import observed_pool
from tests.scenery.film import RIG, Film, film
from tests.scenery.patience import LONG_S

T_BODY_CAMERA = make_transform(AXES_MAP_WORLD, np.zeros(3))
T_SURVEY_WORLD = make_transform(exp_so3(np.array([0.0, 2.0, 0.0])), np.array([4e5, 5e6, 100.0]))


def doubts(film: Film, poses: Float64) -> tuple[str, ...]:
    # Poses in KITTI's format have no times; those of the images are another matter.
    known = Trajectory(poses, np.arange(len(poses), dtype=np.float64))
    return doubt_poses(known, film, DriveSettings())


@pytest.fixture(scope="module")
def street():
    return film(StreetScene(frames=8, seed=1, **RIG))


@pytest.mark.parametrize("T_there_world", [np.eye(4), T_SURVEY_WORLD])
def test_right_poses_are_not_doubted(street, T_there_world):
    assert doubts(street, T_there_world @ street.trajectory.T_world_camera) == ()
    assert doubts(street.taken(slice(0, 1)), np.eye(4)[None]) == ()
    with pytest.raises(RegistrationError, match="fewer known poses than frames"):
        doubts(street, street.trajectory.T_world_camera[:5])


def scaled(poses: Float64) -> Float64:
    poses = poses.copy()
    poses[:, :3, 3] *= 1.5
    return poses


@pytest.mark.parametrize("change", [scaled, invert, lambda poses: poses[::-1].copy()])
def test_poses_that_contradict_the_images_are_doubted(street, change):
    (line,) = doubts(street, change(street.trajectory.T_world_camera))
    assert "contradict what the cameras see" in line
    assert "standard deviations off" in line


def test_poses_of_a_body_are_recognised(street):
    poses = T_BODY_CAMERA @ street.trajectory.T_world_camera @ invert(T_BODY_CAMERA)
    (line,) = doubts(street, poses)
    assert "as those of a body" in line


GREY = np.zeros((16, 16), np.uint8)
TINY = RectifiedCamera(10.0, 8.0, 8.0, 8.0, 0.5, 16, 16)


class Live:
    """What a live source tells of itself, and a mapper that maps a frame when it may."""

    def __init__(self) -> None:
        self.unmatched, self.done = 0, []
        self.begun, self.go = Event(), Event()

    def note_unmatched(self) -> None:
        self.unmatched += 1

    def map(self, pair: RectifiedPair, result: OdometryResult, matched: bool) -> None:
        self.begun.set()
        self.go.wait(LONG_S)
        self.done.append((pair.index, matched))


def _waiting(index: int) -> tuple[RectifiedPair, OdometryResult]:
    pair = RectifiedPair(GREY, GREY, TINY, index=index)
    return pair, OdometryResult(np.eye(4), OdometryHealth())


def test_of_frames_that_wait_the_newest_is_matched():
    live = Live()
    behind = MapBehind(live, live.map)
    behind.add(_waiting(0))
    live.begun.wait(LONG_S)
    for index in range(1, 5):
        behind.add(_waiting(index))
    live.go.set()
    behind.wait()
    behind.stop()
    assert live.done == [(0, True), (1, False), (2, False), (3, False), (4, True)]
    assert live.unmatched == 3


def test_the_first_frame_is_matched_however_late_it_is():
    live = Live()
    live.go.set()
    behind = MapBehind(live, live.map)
    with behind._news:
        behind._waiting.extend(_waiting(index) for index in range(3))
        behind._news.notify_all()
    behind.wait()
    behind.stop()
    assert live.done == [(0, True), (1, False), (2, True)]


def test_what_goes_wrong_is_raised_where_frames_are_added():
    def fail(*_: object) -> None:
        raise MappingError("no")

    behind = MapBehind(Live(), fail)
    with pytest.raises(MappingError, match="no"):  # noqa: PT012 - in one or the other
        behind.add(_waiting(0))
        behind.wait()
    with pytest.raises(MappingError, match="no"):
        behind.add(_waiting(1))
    behind.stop()


# Loops: each place is a wall of its own, 10 m ahead; the drive is one lap and a bit of a circle.
CAMERA = RectifiedCamera(200.0, 159.5, 59.5, 159.5, 0.5, 320, 120)
LAP = 60
FRAMES = LAP + 8
STEP_M = 2.0
MEASURED = [OdometryHealth()] * FRAMES


def _frame(index: int) -> ReconstructedFrame:
    rng = np.random.default_rng(index % LAP)
    noise = cv2.GaussianBlur(rng.normal(size=(120, 320)), (0, 0), 2.0)
    grey = np.clip(128 + 60 * noise / noise.std(), 0, 255).astype(np.uint8)
    values = np.tile(np.linspace(9.0, 11.0, 320, dtype=np.float32), (120, 1))
    ones = np.ones_like(values)
    disparity = Disparity(values, ones, 0.3 * ones, np.zeros(values.shape, np.uint8))
    pair = RectifiedPair(grey, grey, CAMERA, index=index)
    return ReconstructedFrame(pair, disparity, PointCloud(np.zeros((0, 3), np.float32)))


def _circle(ratio: float = 0.0) -> Trajectory:
    """The path; with a share, each step is too long by that much."""
    turn = 2 * math.pi / LAP
    step = make_transform(
        exp_so3(np.array([0.0, turn, 0.0])), np.array([0.0, 0.0, STEP_M * (1.0 + ratio)])
    )
    poses = [np.eye(4)]
    for _ in range(FRAMES - 1):
        poses.append(poses[-1] @ step)
    if ratio:  # odometry is not wrong in the same way everywhere, or even a circle would close
        tilt = make_transform(exp_so3(np.array([0.0, 0.03, 0.0])), np.zeros(3))
        poses[LAP // 2 :] = [
            poses[LAP // 2] @ tilt @ invert(poses[LAP // 2]) @ T for T in poses[LAP // 2 :]
        ]
    return Trajectory(np.stack(poses), 0.1 * np.arange(FRAMES))


@pytest.fixture(scope="module")
def frames():
    return [_frame(k) for k in range(FRAMES)]


def _watch(frames, path, store=None, upto=FRAMES, committed=0):
    store = store or Store.temporary()
    watch = LoopWatch(Keyframes(store), CAMERA)
    for number, (frame, T) in enumerate(zip(frames[:upto], path.T_world_camera, strict=False)):
        if number == committed:
            watch.wait()
            store.commit()
        watch.add(frame, T, 0)
    watch.wait()
    return watch


@pytest.fixture(scope="module")
def closed(frames):
    path = _circle(0.01)
    return _watch(frames, path).close(path, MEASURED)


def _pairs(loops: DriveLoops) -> list[tuple[int, int, bytes]]:
    return [(o.first, o.last, o.T_first_last.tobytes()) for o in loops.closure.closed]


def test_a_lap_closes_and_a_drive_without_loops_stays_as_it_is(frames, closed):
    truth = _circle()

    before, after = (
        np.linalg.norm(path.positions_m[-1] - truth.positions_m[-1])
        for path in (closed.odometry, closed.closure.trajectory)
    )
    assert before > 1.0
    # 1 % of the 14 m after the end of the lap, which no loop can tell, and 5 cm of the loops.
    assert after < 0.2
    assert {(o.first, o.last) for o in closed.closure.closed} <= {
        (k, LAP + k) for k in range(FRAMES - LAP)
    }
    figures = closed.figures().to_json()
    assert figures["keyframes"] == FRAMES
    assert figures["closed"] == len(closed.closure.closed) >= 5
    assert figures["largest_correction_m"] == pytest.approx(closed.corrections_m.max())
    assert closed.warnings() == []
    short = Trajectory(truth.T_world_camera[:40], truth.timestamps_s[:40])
    loops = _watch(frames, short, upto=40).close(short, MEASURED[:40])
    assert loops.closure.trajectory is loops.odometry


@pytest.mark.parametrize(("checkpoint", "killed"), [(30, 30), (30, 35), (64, 67)])
def test_an_interrupted_drive_gives_the_same_loops(frames, closed, tmp_path, checkpoint, killed):
    path = closed.odometry
    with Store.create(tmp_path / "map.recon") as store:
        _watch(frames, path, store, upto=killed + 1, committed=checkpoint)
    keyframes = Keyframes(Store.open(tmp_path / "map.recon"))
    assert len(list(keyframes)) == checkpoint
    resumed = LoopWatch(keyframes, CAMERA)
    resumed.restore(path.T_world_camera[:checkpoint], np.zeros(checkpoint, np.int64))
    for frame, T in zip(frames[checkpoint:], path.T_world_camera[checkpoint:], strict=True):
        resumed.add(frame, T, 0)

    loops = resumed.close(path, MEASURED)
    assert (_pairs(loops), loops.figures().to_json()) == (
        _pairs(closed),
        closed.figures().to_json(),
    )
    assert np.array_equal(
        loops.closure.trajectory.T_world_camera, closed.closure.trajectory.T_world_camera
    )


def test_a_drive_that_fails_does_not_wait_for_its_loops(frames, monkeypatch):
    looked: list[int] = []
    pool, dropped = observed_pool()

    def slow(self: LoopDetector, frame: int, *_: object, **__: object) -> None:
        looked.append(frame)
        dropped.wait(LONG_S)

    monkeypatch.setattr(LoopDetector, "add", slow)
    monkeypatch.setattr(drive_loops, "ThreadPoolExecutor", pool)
    watch = LoopWatch(Keyframes(Store.temporary()), CAMERA)
    for frame in frames[:4]:
        watch.add(frame, np.eye(4), 0)
    while not looked:
        time.sleep(0.001)
    watch.stop()
    assert looked == [0]


def test_what_contradicts_odometry_or_itself_is_a_warning(closed):
    # Odometry is believed to the millimetre, so that bending it is impossible.
    path, drive = closed.odometry, DrivePath.of(closed.odometry, MEASURED)
    with patch.multiple(places, SHARE=1e-6, TURN_DEG=1e-5):
        refused = close_loops(drive, list(closed.closure.closed))
    loops = DriveLoops(path, refused, FRAMES, len(closed.closure.closed), {})

    assert refused.trajectory is path
    assert "none closed" in loops.warnings()[0]
    nothing = close_loops(drive, [])
    for times, warned in ((2, False), (3, True)):  # places where the drive cannot have been
        loops = DriveLoops(path, nothing, FRAMES, 0, {CONTRADICTED: times})
        assert [("aliasing" in text) for text in loops.warnings()] == [True] * warned
