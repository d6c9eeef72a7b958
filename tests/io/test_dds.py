"""Messages over loopback, as nodes of ROS 2 exchange them."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from cyclonedds.core import Policy

from recon.core.errors import FormatError, ReconError
from recon.core.values import OccupancyGrid, PointCloud
from recon.io.ros import dds
from recon.io.ros.dds import Network, NetworkTopic, Received, configuration_of, domain_of
from recon.io.ros.messages import encode, grid_message, header, message_types, points, transforms

NS = 1_795_000_000_123_456_789
IMAGE = "sensor_msgs/msg/Image"


def image(shape=(375, 1242), time_ns=NS):
    pixels = np.arange(shape[0] * shape[1], dtype=np.uint32).astype(np.uint8)
    size = {"height": shape[0], "width": shape[1], "step": shape[1], "encoding": "mono8"}
    return IMAGE, {"header": header("left", time_ns), **size, "data": pixels}


def cloud():
    xyz = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    return points(header("map", NS), PointCloud(xyz, frame="map"))


def covariance(part):
    return {part: {}, "covariance": np.arange(36.0)}


OF_EACH_TYPE = [
    image(),
    ("sensor_msgs/msg/CompressedImage", {"header": header("left", NS), "format": "jpeg",
                                         "data": np.arange(9, dtype=np.uint8)}),
    ("sensor_msgs/msg/CameraInfo", {"header": header("left", NS), "width": 3, "height": 2,
                                    "distortion_model": "plumb_bob", "d": np.arange(5.0),
                                    "k": np.arange(9.0), "r": np.arange(9.0),
                                    "p": np.arange(12.0)}),
    ("sensor_msgs/msg/Imu", {"header": header("imu", NS), "orientation_covariance": np.zeros(9),
                             "angular_velocity_covariance": np.zeros(9),
                             "linear_acceleration_covariance": np.zeros(9)}),
    transforms(NS, [("map", "odom", np.eye(4)), ("odom", "base_link", np.eye(4))]),
    ("nav_msgs/msg/Odometry", {"header": header("odom", NS), "child_frame_id": "base_link",
                               "pose": covariance("pose"), "twist": covariance("twist")}),
    ("nav_msgs/msg/Path", {"header": header("map", NS), "poses": [{"header": header("map", NS)}]}),
    ("geometry_msgs/msg/PoseWithCovarianceStamped", {"header": header("map", NS),
                                                     "pose": covariance("pose")}),
    grid_message(NS, OccupancyGrid(np.array([[0, 100], [-1, 0]], np.int8), 0.2, (-3.0, 4.0))),
    cloud(),
    ("diagnostic_msgs/msg/DiagnosticArray", {"header": header("", NS), "status": [
        {"level": 1, "name": "recon", "message": "coasting",
         "values": [{"key": "sigma_m", "value": "0.1"}]}]}),
]  # fmt: skip


@pytest.fixture
def networks():
    """Two participants in a domain that no other process of the tests is in."""
    domain = 1 + os.getpid() % 200
    two = Network(domain), Network(domain)
    yield two
    for one in two:
        one.close()


def until(network, topic, seconds=5.0):
    end = time.monotonic() + seconds
    while topic not in (found := network.topics()):
        assert time.monotonic() < end, found
        time.sleep(0.02)
    return found[topic]


def take(network, count, seconds=5.0):
    found, end = [], time.monotonic() + seconds
    for messages in network.receive(lambda: time.monotonic() > end):
        found += messages
        if len(found) >= count:
            break
    return found


@pytest.mark.parametrize("message", OF_EACH_TYPE, ids=[kind for kind, _ in OF_EACH_TYPE])
def test_bytes_arrive_as_rosbags_writes_them(networks, message):
    sender, receiver = networks
    sender.write("/some/topic", NS, message, kept=True)
    found = until(receiver, "/some/topic")
    assert found == NetworkTopic("/some/topic", message[0], reliable=True, kept=True, publishers=1)
    receiver.subscribe(found)
    [arrived] = take(receiver, 1)
    assert arrived.content[: len(encode(message))] == encode(message)
    assert len(arrived.content) - len(encode(message)) < 4  # DDS pads to whole words
    parsed = arrived.parse()
    assert bytes(message_types().serialize_cdr(parsed, message[0])) == encode(message)


def test_names_and_qualities_are_those_of_nodes(networks):
    sender, receiver = networks
    sender.write("/map", NS, OF_EACH_TYPE[8], kept=True)
    until(receiver, "/map")
    [end] = [one for one in receiver._endpoints.read(100) if one.topic_name == "rt/map"]
    assert end.type_name == "nav_msgs::msg::dds_::OccupancyGrid_"
    quality = list(end.qos)
    assert Policy.Durability.TransientLocal in quality
    assert any(isinstance(one, Policy.Reliability.Reliable) for one in quality)


def test_who_comes_late_gets_the_last_message_that_is_kept(networks):
    sender, receiver = networks
    for number in range(3):
        grid = OccupancyGrid(np.full((2, 2), number, np.int8), 0.2, (0.0, 0.0))
        sender.write("/map", NS, grid_message(NS, grid), kept=True)
    sender.write("/tf", NS, transforms(NS, []))
    receiver.subscribe(until(receiver, "/map"))
    receiver.subscribe(until(receiver, "/tf"))
    arrived = take(receiver, 2, seconds=1.0)
    assert [(one.topic, one.parse().data.tolist()) for one in arrived] == [("/map", [2, 2, 2, 2])]


def test_nobody_outside_this_machine_is_heard(networks):
    bound = []
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            one = socket.socket(fileno=os.dup(int(descriptor.name)))
        except OSError:  # not a socket
            continue
        with one:
            if one.family == socket.AF_INET and one.type == socket.SOCK_DGRAM:
                device = one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16)
                bound.append((one.getsockname()[0], device.rstrip(b"\0")))
    assert bound
    assert all(place == "127.0.0.1" or device == b"lo" for place, device in bound), bound


def test_a_network_that_was_left_is_silent(networks):
    sender, receiver = networks
    receiver.close()
    assert list(receiver.receive()) == []
    with pytest.raises(ReconError, match="left already"):
        receiver.write("/tf", NS, transforms(NS, []))
    sender.write("/tf", NS, transforms(NS, []))  # the other goes on


@pytest.mark.parametrize("content", [b"", b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 40])
def test_bytes_that_are_no_message_are_one_line(content):
    with pytest.raises(FormatError, match="/left: message cannot be read") as caught:
        Received("/left", IMAGE, content, 0.0).parse()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["-1", "233", "two", "1.5", "٣"])
def test_a_domain_is_a_number_that_has_ports(text):
    with pytest.raises(ReconError, match="ROS_DOMAIN_ID: not a domain of ROS 2"):
        domain_of({"ROS_DOMAIN_ID": text})


def test_the_environment_says_who_is_talked_to():
    assert domain_of({}) == domain_of({"ROS_DOMAIN_ID": " "}) == 0
    assert domain_of({"ROS_DOMAIN_ID": "42"}) == 42
    inside, words = configuration_of({})
    assert inside is not None
    assert "127.0.0.1" in inside
    assert words.startswith("this machine alone")
    assert configuration_of({"ROS_AUTOMATIC_DISCOVERY_RANGE": "subnet"})[0] is None
    assert configuration_of({"CYCLONEDDS_URI": "<CycloneDDS/>"})[0] is None
    with pytest.raises(ReconError, match="LOCALHOST or SUBNET"):
        configuration_of({"ROS_AUTOMATIC_DISCOVERY_RANGE": "EVERYBODY"})


def test_the_configuration_of_the_environment_is_what_cyclone_gets(tmp_path):
    """A domain that is begun with none of its own does not look at the environment."""
    log = tmp_path / "cyclone.log"
    tracing = f"<Verbosity>config</Verbosity><OutputFile>{log}</OutputFile>"
    text = f"<CycloneDDS><Domain><Tracing>{tracing}</Tracing></Domain></CycloneDDS>"
    (tmp_path / "there.xml").write_text(text)
    code = "from recon.io.ros.dds import Network; Network(3).close()"
    for uri in (text, f"file://{tmp_path / 'there.xml'}"):
        environment = {**os.environ, "CYCLONEDDS_URI": uri}
        subprocess.run([sys.executable, "-c", code], env=environment, check=True)
        assert str(log) in log.read_text()
        log.unlink()


@pytest.mark.parametrize("text", ["file:///nowhere/none.xml", "<CycloneDDS", "nowhere.xml"])
def test_a_wrong_configuration_of_cyclone_is_one_line(text):
    """Cyclone would go on without, and talk to the whole network."""
    code = "from recon.io.ros.dds import Network; Network(3)"
    ran = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "CYCLONEDDS_URI": text},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "SettingsError: CYCLONEDDS_URI: not a configuration" in ran.stderr


def test_types_are_described_once():
    assert dds._type_of(IMAGE) is dds._type_of(IMAGE)
    assert dds._kind_of("sensor_msgs::msg::dds_::Image_") == IMAGE
    assert dds._kind_of("sensor_msgs::msg::dds_::Nothing_") is None
    assert dds._kind_of("") is None
