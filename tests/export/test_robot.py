"""Topics of a robot: frames of REP 105, a path that stays small, a map that grows; by `rosbags`."""

from collections import Counter
from dataclasses import replace
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon.core.errors import FormatError, OutputError
from recon.core.geometry.se3 import as_step, as_transform, invert, make_transform
from recon.core.values import RectifiedCamera
from recon.export.growing import GrowingMap, MapBeside
from recon.export.occupancy import Flattening
from recon.export.robot import RobotTopics
from recon.io.ros import bag as bag_file
from recon.io.ros.bag import write_bag
from recon.io.ros.messages import NS_PER_S, Message, encode, transforms
from recon.map.drive.drive import Workspace
from recon.map.drive.drive_odometry import mount_of
from recon.map.drive.sequence import map_sequence
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.listener import DriveBegun, DriveListener, DrivePose
from recon.map.localize.localizer import State
from recon.map.map import Map
from recon.map.sessions.placed import place_map
from recon.map.settings import DriveSettings
from recon.odometry.protocol import OdometryHealth
from recon.sources.live import LiveSource
from recon.sources.source import Latency, LiveFigures, Mount, SourceFigures
from recon.stereo.rectify.rectifier import RectificationSettings
from recon.street.settings import StreetScene
from tests.scenery.film import RIG, Film, film
from tests.scenery.patience import LONG_S, be_patient

pytest.importorskip("rosbags")

CAMERA = RectifiedCamera(180.0, 159.5, 59.5, 159.5, 0.5, 320, 120)
T_BASE_CAMERA = make_transform(AXES_MAP_WORLD, np.array([0.4, 0.0, 1.2]))
UNIT = np.eye(6)


class Written:
    """Takes messages, and decodes their bytes as another program does."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self.messages: list[tuple[str, int, Any, bool]] = []

    def write(self, topic: str, time_ns: int, message: Message, *, kept: bool = False) -> None:
        read = self.store.deserialize_cdr(encode(message), message[0])
        self.messages.append((topic, time_ns, read, kept))

    def of(self, topic: str) -> list[Any]:
        return [message for name, _, message, _ in self.messages if name == topic]


def matrix(part: Any) -> np.ndarray:
    from recon.core.geometry.se3 import rotation_from_quaternion

    place = getattr(part, "translation", None) or part.position
    turn = getattr(part, "rotation", None) or part.orientation
    R = rotation_from_quaternion(np.array([turn.x, turn.y, turn.z, turn.w]))
    return make_transform(R, np.array([place.x, place.y, place.z]))


def begun(source: Any = None, *, in_map: bool = True, mount: Mount | None = None) -> DriveBegun:
    still = Film([], CAMERA, np.zeros((0, 4, 4))) if source is None else source
    return DriveBegun(still, CAMERA, None, in_map, mount)


def ahead(n: int, speed: float = 0.5) -> np.ndarray:
    """Where the camera is after n frames on a bend, by odometry."""
    return as_transform(np.array([0.1 * speed * n**1.5 / 30, 0.0, speed * n, 0.0, -0.01 * n, 0.0]))


def drive_pose(n: int, T_map_world: np.ndarray | None, state: State = State.TRACKING, **more: Any):
    T = None if T_map_world is None else T_map_world @ ahead(n)
    known = {"health": OdometryHealth(sigma_m=0.01, sigma_deg=0.1), **more}
    covariance = None if T is None else 1e-4 * UNIT
    drift = 1e-6 * n * UNIT
    return DrivePose(
        100 + 0.1 * n, ahead(n), T_BASE_CAMERA, drift, state=state, T_map_camera=T,
        covariance=covariance, **known,
    )  # fmt: skip


def jumping(n: int) -> np.ndarray:
    """What localisation says of the origin of the odometry: a metre to the side from frame 10."""
    return make_transform(AXES_MAP_WORLD, np.array([3.0, 1.0 * (n >= 10), 1.2]))


def tree(message: Any) -> dict[str, np.ndarray]:
    return {f"{one.header.frame_id}>{one.child_frame_id}": matrix(one.transform)
            for one in message.transforms}  # fmt: skip


def test_the_tree_of_frames_gives_the_pose_and_odometry_never_jumps():
    out = Written()
    topics = RobotTopics([out])
    topics.on_begin(begun())
    for n in range(20):
        topics.on_pose(drive_pose(n, jumping(n)))
    frames, placed = [tree(one) for one in out.of("/tf")], out.of("/pose")
    assert len(frames) == len(placed) == 20
    for n, (one, pose) in enumerate(zip(frames, placed, strict=True)):
        T_map_base = jumping(n) @ ahead(n) @ invert(T_BASE_CAMERA)
        np.testing.assert_allclose(one["map>odom"] @ one["odom>base_link"], T_map_base, atol=1e-9)
        np.testing.assert_allclose(matrix(pose.pose.pose), T_map_base, atol=1e-9)
    np.testing.assert_allclose(frames[0]["odom>base_link"], np.eye(4), atol=1e-9)
    steps = [as_step(invert(a["odom>base_link"]) @ b["odom>base_link"])
             for a, b in pairwise(frames)]  # fmt: skip
    assert np.linalg.norm(np.array(steps)[:, :3], axis=1).max() < 0.6  # half a metre each
    jumps = [np.linalg.norm(b["map>odom"][:3, 3] - a["map>odom"][:3, 3]) > 0.9
             for a, b in pairwise(frames)]  # fmt: skip
    assert np.flatnonzero(jumps).tolist() == [9]
    (fixed,), kept = out.of("/tf_static"), [k for name, _, _, k in out.messages if k]
    np.testing.assert_allclose(tree(fixed)["base_link>left"], T_BASE_CAMERA, atol=1e-9)
    assert tree(fixed)["left>right"][0, 3] == 0.5
    assert len(kept) == 1
    assert [one.transforms[0].header.stamp.sec for one in out.of("/tf")][::10] == [100, 101]


def test_no_place_is_claimed_before_the_first_fix_and_the_last_one_is_kept():
    out = Written()
    topics = RobotTopics([out])
    topics.on_begin(begun())
    topics.on_pose(drive_pose(0, None, State.SEARCHING, note="nothing is recognised"))
    topics.on_pose(drive_pose(1, jumping(1)))
    topics.on_pose(drive_pose(2, None, State.LOST, note="too uncertain"))
    nowhere = OdometryHealth(ok=False, notes=("no features",))
    topics.on_pose(drive_pose(3, None, State.LOST, health=nowhere))
    frames = [tree(one) for one in out.of("/tf")]
    assert [sorted(one) for one in frames] == [
        ["odom>base_link"], ["map>odom", "odom>base_link"], ["map>odom", "odom>base_link"],
        ["map>odom"],
    ]  # fmt: skip
    np.testing.assert_array_equal(frames[3]["map>odom"], frames[1]["map>odom"])
    assert len(out.of("/pose")) == 1
    assert len(out.of("/odometry")) == 3
    said = [(one.status[0].level, one.status[0].message) for one in out.of("/diagnostics")]
    assert said == [(1, "nothing is recognised"), (0, "tracking"), (2, "too uncertain")]


def test_a_drive_that_makes_a_map_has_odometry_and_map_in_one_place():
    out = Written()
    topics = RobotTopics([out], "front/")
    topics.on_begin(begun(in_map=False))
    for n in range(3):
        topics.on_pose(drive_pose(n, jumping(n)))
    for one in map(tree, out.of("/tf")):
        np.testing.assert_allclose(one["map>front/odom"], np.eye(4), atol=1e-9)
    assert {"/front/odometry", "/front/pose", "/front/path"} < {name for name, *_ in out.messages}


def test_speed_is_that_of_the_base_and_its_uncertainty_is_said():
    out = Written()
    topics = RobotTopics([out])
    topics.on_begin(begun())
    for n in range(3):
        T = make_transform(np.eye(3), np.array([0.0, 0.0, 0.3 * n]))
        topics.on_pose(replace(drive_pose(n, None), T_world_camera=T))
    first, _, last = out.of("/odometry")
    assert first.twist.covariance[0] == -1.0  # nothing is known of it
    assert last.twist.twist.linear.x == pytest.approx(3.0)
    assert last.twist.twist.linear.y == pytest.approx(0.0, abs=1e-9)
    # A centimetre in a tenth of a second, and what a turn does to a base below the camera.
    turned = (1.2**2 + 0.4**2) * np.deg2rad(0.1) ** 2
    spread = np.diag(last.twist.covariance.reshape(6, 6))
    assert spread[:3].sum() == pytest.approx((3 * 0.01**2 + 2 * turned) / 0.1**2)


def test_the_covariance_of_a_pose_is_that_of_the_base_in_the_axes_of_the_map():
    """By what small steps of the camera, one in each direction, do to what the message has."""
    rng = np.random.default_rng(1)
    root = 1e-3 * rng.normal(size=(6, 6))
    found = replace(drive_pose(7, jumping(7)), covariance=root @ root.T)
    out = Written()
    topics = RobotTopics([out])
    topics.on_begin(begun())
    topics.on_pose(found)
    T_map_base = found.T_map_base
    columns = []
    for step in np.eye(6) * 1e-6:
        moved = found.T_map_camera @ as_transform(step) @ invert(T_BASE_CAMERA)
        turn = as_step(make_transform(moved[:3, :3] @ T_map_base[:3, :3].T, np.zeros(3)))[3:]
        columns.append(np.r_[moved[:3, 3] - T_map_base[:3, 3], turn] / 1e-6)
    J = np.array(columns).T
    said = out.of("/pose")[0].pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(said, J @ found.covariance @ J.T, rtol=1e-3, atol=1e-9)


def test_a_path_stays_small_however_long_the_drive():
    out = Written()
    topics = RobotTopics([out])
    topics.on_begin(begun())
    for n in range(600):
        topics.on_pose(_straight(n))
    paths = out.of("/path")
    assert len(paths) == 60  # one a second
    assert max(len(one.poses) for one in paths) <= 300
    places = np.array([matrix(one.pose)[0, 3] for one in paths[-1].poses])
    assert places[0] == pytest.approx(-0.4)
    assert places[-1] == pytest.approx(599, abs=10)
    assert 2 <= np.diff(places).max() < 10
    assert len(places) > 100


def _straight(n: int) -> DrivePose:
    T = make_transform(np.eye(3), np.array([0.0, 0.0, float(n)]))
    return replace(
        drive_pose(0, jumping(0)), time_s=100 + 0.1 * n, T_world_camera=T,
        T_map_camera=make_transform(AXES_MAP_WORLD, np.array([0.0, 0.0, 1.2])) @ T,
    )  # fmt: skip


def test_diagnostics_say_how_the_drive_is_kept_up_with():
    still = Film([], CAMERA, np.zeros((0, 4, 4)))
    kept = LiveFigures(rate=1.0, frames_arrived=9, frames_dropped=4, frames_not_matched=2,
                       latency_ms=Latency(20.0, 30.0, 40.0))  # fmt: skip
    still.figures = lambda: SourceFigures(live=kept)
    out = Written()
    topics = RobotTopics([out])
    topics.on_begin(begun(still))
    for n in range(25):
        topics.on_pose(drive_pose(n, jumping(0)))
    first, *_ = said = out.of("/diagnostics")
    assert len(said) == 3  # each second
    values = {one.key: one.value for one in first.status[0].values}
    assert values["frames_dropped"] == "4"
    assert values["latency_p95_ms"] == "30.0"
    assert float(values["sigma_m"]) == pytest.approx(np.sqrt(3e-4), abs=1e-4)
    assert first.status[0].hardware_id == "film"


def test_a_writer_that_fails_is_left_and_the_others_go_on(caplog):
    class Full:
        def write(self, topic: str, *_: Any, **__: Any) -> None:
            if topic == "/odometry":
                raise OutputError("the disk is full")

    out = Written()
    topics = RobotTopics([Full(), out])
    topics.on_begin(begun())
    for n in range(3):
        topics.on_pose(drive_pose(n, jumping(0)))
    assert len(out.of("/pose")) == 3
    assert [one.getMessage() for one in caplog.records] == [
        "topics are not written any more: the disk is full"
    ]
    assert topics.warnings() == ["topics were written only in part: the disk is full"]


@pytest.mark.parametrize("time_s", [-1.0, float("nan"), 3e9])
def test_a_time_that_messages_cannot_have_is_refused(time_s):
    topics = RobotTopics([Written()])
    topics.on_begin(begun())
    with pytest.raises(FormatError, match="do not fit"):
        topics.on_pose(replace(drive_pose(0, None), time_s=time_s))


def test_a_frame_that_has_a_parent_on_the_robot_gets_no_other():
    T_base_root = make_transform(np.eye(3), np.array([0.0, 0.0, 0.3]))
    mount = Mount(T_BASE_CAMERA, "base_footprint", "cam", "base_link", T_base_root)
    out = Written()
    topics = RobotTopics([out])
    topics.on_begin(begun(mount=mount))
    topics.on_pose(drive_pose(0, None))
    found = tree(out.of("/tf")[0])
    assert "odom>base_footprint" not in found
    np.testing.assert_allclose(found["odom>base_link"][2, 3], 0.3, atol=1e-9)


def test_where_the_robot_says_its_camera_is_counts():
    source = Film([], CAMERA, np.zeros((0, 4, 4)))
    source.read_mount = lambda: Mount(T_BASE_CAMERA, "base_footprint", "stereo")
    mount, _ = mount_of(source, RectificationSettings())
    out = Written()
    topics = RobotTopics([out])
    topics.on_begin(begun(source, mount=mount))
    topics.on_pose(drive_pose(0, None))
    found = tree(out.of("/tf_static")[0])["base_footprint>stereo_rectified"]
    np.testing.assert_allclose(found, T_BASE_CAMERA, atol=1e-12)
    assert "odom>base_footprint" in tree(out.of("/tf")[0])


class Growing(DriveListener):
    """Makes the map anew after each commit."""

    path: Path
    made: list[Any]

    def on_begin(self, begun: DriveBegun) -> None:
        self.growing, self.made = GrowingMap(begun.map_path), []

    def on_map(self) -> None:
        self.made.append(self.growing.update())


@pytest.fixture(scope="module")
def street():
    return film(StreetScene(frames=10, seed=1, **RIG))


def test_a_map_that_is_made_where_it_grows_is_the_whole_one(street, tmp_path):
    """But for the height of the camera, which is measured along what is made anew."""
    short = {"submaps": {"length_m": 2.0}, "checkpoints": {"every_frames": 3},
             "occupancy": {"max_range_m": 6.0}}  # fmt: skip
    settings, listener = DriveSettings.parse(short), Growing()
    with Map.create(tmp_path / "map.recon") as map_:
        map_sequence(street, settings, workspace=Workspace(map_, listener=listener))
        map_.commit()
        listener.on_map()
        made = [one for one in listener.made if one is not None]
        grid, _, _ = Flattening(place_map(map_, settings)).grid()
        assert len(map_.first.submaps) >= 4
    assert len(made) >= 3
    sizes = [one.grid.cells.size for one in made]
    assert sizes == sorted(sizes)
    assert made[-1].grid.origin_m == pytest.approx(grid.origin_m)
    assert made[-1].grid.cells.shape == grid.cells.shape
    assert (made[-1].grid.cells == grid.cells).mean() > 0.99
    assert any(len(one.cloud) for one in made)
    assert made[-1].costs.cells.shape == grid.cells.shape


def test_a_process_that_makes_maps_ends_silently_with_who_asked(tmp_path, capfd):
    beside = MapBeside(tmp_path / "none.recon")
    beside._process.stdout.close()  # as of a program that is killed while a map is made
    beside._process.stdin.write(b"\n")
    beside._process.stdin.close()
    assert beside._process.wait(LONG_S) == 0
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_the_topics_of_a_drive_have_its_map(street, tmp_path, monkeypatch):
    be_patient(monkeypatch)
    out, played = Written(), LiveSource(street, rate=100.0)
    with Map.create(tmp_path / "map.recon") as map_:
        topics = RobotTopics([out])
        map_sequence(played, DriveSettings(), workspace=Workspace(map_, listener=topics))
        grid, _, _ = Flattening(place_map(map_, DriveSettings())).grid()
        T_map_camera = map_.first.T_map_world @ map_.first.odometry.T_world_camera[-1]
    topic = Counter(name for name, *_ in out.messages)
    assert topic["/tf"] == topic["/pose"] == len(street) - 1  # the first one gives the axes
    *_, written = out.of("/map")
    assert (written.info.height, written.info.width) == grid.cells.shape
    np.testing.assert_array_equal(written.data, grid.cells.ravel())
    assert out.of("/costmap")[0].data.min() == -1
    assert out.of("/cloud")[0].header.frame_id == "map"
    assert {name for name, _, _, kept in out.messages if kept} == {
        "/tf_static", "/map", "/costmap"
    }  # fmt: skip
    last, fixed = tree(out.of("/tf")[-1]), tree(out.of("/tf_static")[0])
    np.testing.assert_allclose(
        last["map>odom"] @ last["odom>base_link"] @ fixed["base_link>left"], T_map_camera, atol=1e-9
    )


def test_a_bag_that_is_written_as_it_goes_can_be_read_when_the_program_is_killed(
    tmp_path, monkeypatch
):
    pytest.importorskip("mcap")
    from mcap.exceptions import EndOfFile
    from mcap.stream_reader import StreamReader

    monkeypatch.setattr(bag_file, "_FLUSH_S", 0.0)
    with write_bag(tmp_path / "bag", as_it_goes=True) as bag:
        for n in range(20):
            bag.write("/tf", n * NS_PER_S, transforms(n * NS_PER_S, [("map", "odom", np.eye(4))]))
        left = BytesIO((tmp_path / "bag/bag.mcap").read_bytes())
    names = Counter[str]()
    records = iter(StreamReader(left).records)
    with pytest.raises(EndOfFile):  # for want of what ends a bag, which `mcap recover` makes
        names.update(type(one).__name__ for one in records)
    assert names["Message"] == 20
