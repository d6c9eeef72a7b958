"""Topics of ROS 2 as a source, over loopback within this process."""

import logging
import os
import threading
import time
from contextlib import closing, contextmanager
from itertools import count

import numpy as np
import pytest

from recon.core.errors import ReconError
from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import RectifiedCamera
from recon.io.ros.dds import Network
from recon.io.ros.messages import header, pose, transforms
from recon.sources import ros2
from recon.sources.live import LiveSource
from recon.sources.ros2 import open_ros2
from recon.sources.settings import SourceSettings
from tests.scenery.ros2_player import image_message, imu_message, mount

CAMERA = RectifiedCamera(60.0, 31.5, 15.5, 31.5, 0.5, 64, 32)
PERIOD_NS = 50_000_000
BEGIN_NS = 1_795_000_000_123_456_789


def picture(number, side):
    """An image that tells its pair and side, and that JPEG keeps nearly as it is."""
    return np.full((32, 64), 10 * (number % 20) + side, np.uint8)


class Robot(threading.Thread):
    """Publishes a pair every 20 ms, whose stamps are 50 ms apart; ``also`` gives more messages."""

    def __init__(self, *, late_ns=0, compressed=False, also=lambda number, at_ns: (), first=0):
        super().__init__(daemon=True)
        self.late_ns, self.compressed, self.also, self.first = late_ns, compressed, also, first
        self.over = threading.Event()

    def run(self):
        with closing(Network()) as network:
            network.write("/tf_static", 0, transforms(BEGIN_NS, mount()), kept=True)
            for number in count(self.first):
                if self.over.wait(0.02):
                    return
                at_ns = BEGIN_NS + number * PERIOD_NS
                for topic, message in self.messages(number, at_ns):
                    network.write(topic, at_ns, message)

    def messages(self, number, at_ns):
        yield from self.also(number, at_ns)
        suffix = "/compressed" if self.compressed else ""
        for side, name in enumerate(("left", "right")):
            stamp_ns = at_ns + side * self.late_ns
            image = image_message(picture(number, side), name, stamp_ns, compressed=self.compressed)
            yield f"/{name}/image_raw{suffix}", image
            yield f"/{name}/camera_info", info(side, stamp_ns)


def info(side, at_ns):
    P = np.array([[60.0, 0, 31.5, -side * 30.0], [0, 60.0, 15.5, 0], [0, 0, 1, 0]])
    content = {"width": 64, "height": 32, "distortion_model": "plumb_bob", "d": np.zeros(5),
               "k": P[:, :3].ravel(), "r": np.eye(3).ravel(), "p": P.ravel()}  # fmt: skip
    return "sensor_msgs/msg/CameraInfo", {
        "header": header(("left", "right")[side], at_ns),
        **content,
    }


@contextmanager
def playing(**how):
    robot = Robot(**how)
    robot.start()
    try:
        yield robot
    finally:
        robot.over.set()
        robot.join()


@pytest.fixture(autouse=True)
def _own_domain(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 200))
    monkeypatch.setattr(ros2, "_PATIENCE_S", 5.0)


def pairs_of(source, number):
    frames = source.frames()
    return [next(frames) for _ in range(number)]


@pytest.mark.parametrize("compressed", [False, True])
def test_pairs_arrive_as_they_were_sent(compressed):
    with playing(compressed=compressed), open_ros2("ros2:", SourceSettings()) as source:
        assert repr(source.calibration) == repr(CAMERA)
        for index, pair in enumerate(pairs_of(source, 5)):
            stamp_ns = source.stamp_ns(pair.timestamp_s)
            number, left = divmod(stamp_ns - BEGIN_NS, PERIOD_NS)
            assert (pair.index, left) == (index, 0)  # to the nanosecond
            assert abs(pair.timestamp_s - 1e-9 * stamp_ns) < 2.4e-7  # the step of 64 bits
            for side, image in enumerate((pair.left, pair.right)):
                off = image.astype(int) - picture(number, side)
                assert np.abs(off).max() <= (1 if compressed else 0)
            assert 0 <= time.monotonic() - source.due_s(pair) < 1
        assert source.warnings() == []


def test_topics_are_named_or_found(monkeypatch):
    settings = SourceSettings()
    with playing():
        for address in ("ros2:/left/image_raw", "ros2:/left/image_raw,/right/image_raw"):
            with open_ros2(address, settings) as source:
                assert source.images == ("/left/image_raw", "/right/image_raw")
                assert "this machine alone" in source.description
        monkeypatch.setattr(ros2, "_PATIENCE_S", 1.0)
        with (
            pytest.raises(
                ReconError, match=r"no such image topic \(got /up/image.*/left/image_raw"
            ),
            open_ros2("ros2:/up/image,/down/image", settings),
        ):
            pass


@pytest.mark.parametrize("address", ["ros2:left", "ros2:/a,/b,/c", "ros2:/a,/a", "ros2:/a,b"])
def test_an_address_that_is_none_is_one_line(address):
    with (
        pytest.raises(ReconError, match="not topics of two cameras"),
        open_ros2(address, SourceSettings()),
    ):
        pass


def test_where_nobody_publishes_it_is_said_who_was_listened_to(monkeypatch):
    monkeypatch.setattr(ros2, "_PATIENCE_S", 0.5)
    with (
        pytest.raises(ReconError, match=r"no topic at all.*domain \d+ .* this machine alone"),
        open_ros2("ros2:", SourceSettings()),
    ):
        pass


def test_images_are_paired_within_the_tolerance():
    near = SourceSettings(tolerance_s=0.02)
    with playing(late_ns=15_000_000), open_ros2("ros2:", near) as source:
        for pair in pairs_of(source, 4):
            assert int(pair.right[0, 0]) == int(pair.left[0, 0]) + 1
        assert source.warnings() == []


def test_cameras_that_never_agree_are_told_by_how_much_they_differ(caplog, monkeypatch):
    monkeypatch.setattr(ros2, "_QUIET_S", 0.5)
    until_s = time.monotonic() + 60.0
    told = lambda: bool(caplog.records) or time.monotonic() > until_s  # noqa: E731
    with playing(late_ns=20_000_000), open_ros2("ros2:", SourceSettings(), None, told) as source:
        assert list(source.frames()) == []
    assert "stamps are 0.020 s apart (--tolerance)" in caplog.text


def test_images_without_a_partner_are_left_out_and_counted():
    def lone(number, at_ns):
        if number % 3 == 0:
            stamp_ns = at_ns - PERIOD_NS // 2
            image = image_message(picture(99, 0), "left", stamp_ns, compressed=False)
            yield "/left/image_raw", image

    with playing(also=lone), open_ros2("ros2:", SourceSettings()) as source:
        for pair in pairs_of(source, 8):
            assert int(pair.right[0, 0]) == int(pair.left[0, 0]) + 1
        assert source.figures().frames_left_out >= 2


def test_a_publisher_that_is_too_fast_is_thinned_and_that_is_said():
    with playing(), open_ros2("ros2:", SourceSettings()) as source:  # 50 Hz
        live, stamps = LiveSource(source, None), []
        for pair in live.frames():
            time.sleep(0.1)
            stamps.append(source.stamp_ns(pair.timestamp_s))
            if len(stamps) == 6:
                break
        assert live.dropped > 6
        assert np.diff(stamps).min() >= 2 * PERIOD_NS  # spread, not in a row
        assert live.figures().live.frames_dropped == live.dropped
        assert any("arrived too fast, dropped" in line for line in live.warnings())


def bad_messages(number, at_ns):
    """Every fifth time something that no driver should send, on the topic of the left images."""
    topic = "/left/image_raw"
    good = image_message(picture(number, 0), "left", at_ns - 1, compressed=False)[1]
    spoilt = {
        0: {"encoding": "nonsense"},
        5: {"step": 63},
        10: {"height": 31, "data": good["data"][: 31 * 64]},
        15: {"header": header("left", 0)},
        20: {"header": header("left", at_ns - 10 * PERIOD_NS)},
        25: {"header": header("left", 2_000_000_000 * 10**9)},
        30: {"height": 2**31 - 1, "width": 2**31 - 1},
    }.get(number % 35)
    if spoilt is not None:
        yield topic, ("sensor_msgs/msg/Image", {**good, **spoilt})
        # A partner, so that what is wrong with the image decides.
        if "header" not in spoilt:
            partner = image_message(picture(number, 1), "right", at_ns - 1, compressed=False)
            yield "/right/image_raw", partner


def test_nonsense_is_said_once_each_and_the_drive_goes_on(caplog):
    with (
        caplog.at_level(logging.WARNING, "recon"),
        playing(also=bad_messages),
        open_ros2("ros2:", SourceSettings()) as source,
    ):
        pairs = pairs_of(source, 80)
        stamps = [source.stamp_ns(pair.timestamp_s) for pair in pairs]
        assert (np.diff(stamps) > 0).all()
        for pair in pairs:
            assert int(pair.right[0, 0]) == int(pair.left[0, 0]) + 1
        lines = source.warnings()
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == len(set(told)) <= 8
    for fault in ("encoding", "another size", "no time in its header", "not later than"):
        assert any(fault in line for line in told), (fault, told)
        assert any(fault in line and "message" in line for line in lines), (fault, lines)


def test_a_driver_that_starts_again_is_heard_again():
    with open_when(playing()) as (source, first):
        frames = source.frames()
        before = [next(frames) for _ in range(3)]
        first.over.set()
        first.join()
        with playing(first=1000):
            stamps = [source.stamp_ns(pair.timestamp_s) for pair in (*before, *islice_of(frames))]
        assert (np.diff(stamps) > 0).all()
        assert stamps[-1] >= BEGIN_NS + 1000 * PERIOD_NS


@contextmanager
def open_when(robot):
    with robot as first, open_ros2("ros2:", SourceSettings()) as source:
        yield source, first


def islice_of(frames):
    """The pairs until one of the driver that started again."""
    for pair in frames:
        yield pair
        if round(1e9 * pair.timestamp_s) >= BEGIN_NS + 1000 * PERIOD_NS:
            return


def test_where_the_camera_is_on_the_robot_is_in_its_static_transforms():
    with playing(), open_ros2("ros2:", SourceSettings()) as source:
        pairs_of(source, 3)
        found = source.read_mount()
        assert found is not None
        assert found.camera == "left"
        np.testing.assert_allclose(found.T_base_camera, mount()[1][2], atol=1e-12)


def test_an_inertial_unit_and_wheels_are_in_the_axes_of_the_camera():
    T_left_imu = make_transform(exp_so3(np.array([0.1, 0.2, 0.3])), np.array([0.1, 0.0, 0.0]))
    T_base_left = mount()[1][2]

    def sensors(number, at_ns):
        yield "/imu", imu_message(at_ns, np.array([0.0, 0.1, 0.0]), np.array([0.0, 0.0, 9.8]))
        T_odom_base = make_transform(np.eye(3), np.array([0.1 * number, 0.0, 0.0]))
        content = {"header": header("odom", at_ns), "child_frame_id": "base_link",
                   "pose": {"pose": pose(T_odom_base), "covariance": np.zeros(36)},
                   "twist": {"covariance": np.zeros(36)}}  # fmt: skip
        yield "/wheels", ("nav_msgs/msg/Odometry", content)
        yield "/tf_static", transforms(at_ns, [*mount(), ("left", "imu", T_left_imu)])

    with playing(also=sensors), open_ros2("ros2:", SourceSettings(), "/wheels") as source:
        pairs_of(source, 4)
        imu, path = source.read_imu(), source.recent_path()
    assert imu is not None
    assert path is not None
    np.testing.assert_allclose(imu.T_camera_imu, T_left_imu, atol=1e-12)
    np.testing.assert_allclose(imu.gyro, np.tile([0.0, 0.1, 0.0], (len(imu.gyro), 1)))
    step_m = np.diff(path.positions_m, axis=0) / np.diff(path.timestamps_s)[:, None] * 0.05
    np.testing.assert_allclose(step_m, np.tile([0.1, 0.0, 0.0], (len(step_m), 1)), atol=1e-5)
    turn = invert(T_base_left)[:3, :3] @ path.T_world_camera[0, :3, :3]
    np.testing.assert_allclose(turn, np.eye(3), atol=1e-9)


@pytest.mark.parametrize(("rate", "moved_m", "said"), [
    (np.nan, 0.0, "IMU has no measurements"), (0.0, np.nan, "a static transform is no motion"),
])  # fmt: skip
def test_a_broken_unit_does_not_end_the_drive(caplog, rate, moved_m, said):
    T_left_imu = make_transform(np.eye(3), np.array([moved_m, 0.0, 0.0]))

    def sensors(number, at_ns):
        yield "/imu", imu_message(at_ns, np.array([rate, 0.0, 0.0]), np.array([0.0, 0.0, 9.8]))
        yield "/tf_static", transforms(at_ns, [*mount(), ("left", "imu", T_left_imu)])

    with playing(also=sensors), open_ros2("ros2:", SourceSettings()) as source:
        pairs_of(source, 4)
        assert source.read_imu() is None
        assert source.read_imu() is None
        assert source.read_mount() is not None
    assert [said in record.getMessage() for record in caplog.records] == [True]


def test_a_pose_that_rviz_sends_is_given_out_once():
    turn = exp_so3(np.array([0.0, 0.0, 1.0]))

    def rviz(number, at_ns):
        if number % 10 == 0:  # who has begun to publish just now is not heard yet
            T = make_transform(turn, np.array([number, 4.0, 0.0]))
            content = {"header": header("map", at_ns), "pose": {"pose": pose(T),
                       "covariance": np.zeros(36)}}  # fmt: skip
            yield "/initialpose", ("geometry_msgs/msg/PoseWithCovarianceStamped", content)

    with playing(also=rviz), open_ros2("ros2:", SourceSettings()) as source:
        found = [source.asked_start() for _ in source_until(source, 90)]
    given = [one for one in found if one is not None]
    assert len(given) >= 2
    for one in given:
        np.testing.assert_allclose(one[:3, :3], turn, atol=1e-12)
    x_m = np.array([one[0, 3] for one in given])
    assert (x_m % 10 == 0).all()
    assert (np.diff(x_m) > 0).all()


def source_until(source, number):
    """Pairs up to that of a number."""
    for pair in source.frames():
        yield pair
        if round(1e9 * pair.timestamp_s) >= BEGIN_NS + number * PERIOD_NS:
            return


class Thermal(Robot):
    """Cameras of 14 bits, calibrated one by one; the scene gets brighter by 2000 values."""

    def messages(self, number, at_ns):
        T = make_transform(np.eye(3), np.array([0.2, 0.0, 0.0]))
        yield "/tf_static", transforms(at_ns, [("left", "right", T)])
        for side, name in enumerate(("left", "right")):
            values = (thermal() + 2000 * (number > 60) + side).astype("<u2")
            kind, image = image_message(thermal(), name, at_ns, compressed=False)
            data = np.frombuffer(values.tobytes(), np.uint8)
            yield (
                f"/{name}/image_raw",
                (kind, image | {"encoding": "16UC1", "step": 128, "data": data}),
            )
            _, content = info(0, at_ns)
            yield f"/{name}/camera_info", ("sensor_msgs/msg/CameraInfo", content)


def thermal():
    return 7300 + np.arange(32 * 64).reshape(32, 64) // 4


def test_levels_of_deep_images_stay_until_a_scene_is_beyond_them_and_transforms_give_the_baseline(
    caplog,
):
    robot = Thermal()
    robot.start()
    try:
        with caplog.at_level(logging.WARNING), open_ros2("ros2:", SourceSettings()) as source:
            assert source.calibration.baseline_m == pytest.approx(0.2)
            spans, numbers = [], []
            for pair in source.frames():
                numbers.append((source.stamp_ns(pair.timestamp_s) - BEGIN_NS) // PERIOD_NS)
                spans.append(np.ptp(pair.left.astype(int)))
                if numbers[-1] > 66:
                    break
    finally:
        robot.over.set()
        robot.join()
    before = {span for span, number in zip(spans, numbers, strict=True) if number <= 60}
    assert len(before) == 1
    assert 190 < before.pop() < 230  # of 512 values, with room
    assert 0 < spans[-1] < 60  # both scenes are within them now
    assert sum("16-bit images" in one for one in caplog.messages) == 1
