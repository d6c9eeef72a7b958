"""A drive as topics of ROS 2: another process plays it, a listener hears what is made of it."""

import json
import os
import re
import subprocess
import sys
import threading
import time
from collections import defaultdict
from contextlib import closing, contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml

from recon.commands.config import load_config
from recon.commands.localize import run_live
from recon.commands.map_options import MapOptions
from recon.core.geometry.se3 import invert, make_transform, rotation_from_quaternion
from recon.io.ros.contents import CAMERA_INFO, poses_of, stamp_ns
from recon.io.ros.dds import Network, NetworkTopic
from recon.io.ros.messages import message_types
from recon.sources.ros2 import open_ros2
from recon.sources.settings import SourceSettings
from tests.scenery.kitti import write_kitti
from tests.scenery.ros2_player import mount

ROOT = Path(__file__).parents[2]
OURS = re.compile(r"^\| (`/[^|]*) \| `(\w+)` \|", re.MULTILINE)
"""Of the table of topics that are published, on the page."""


KEPT = ("/tf_static", "/map", "/costmap")
KINDS = {kind.rpartition("/")[2]: kind for kind in message_types().fielddefs}


def promised():
    page = (ROOT / "docs/on-a-robot.md").read_text()
    table = page[page.index("## What is published") : page.index("*Transient local*:")]
    return {
        name: kind for names, kind in OURS.findall(table) for name in re.findall(r"/\w+", names)
    }


class Listener(threading.Thread):
    """Keeps all messages of what is promised, and of cameras; and which topics there were."""

    def __init__(self):
        super().__init__(daemon=True)
        self.over, self.heard = threading.Event(), defaultdict(list)
        self.published = {}

    def run(self):
        with closing(Network()) as network:
            network.subscribe(NetworkTopic("/left/camera_info", CAMERA_INFO))
            for name, kind in promised().items():
                kept = name in KEPT
                network.subscribe(NetworkTopic(name, KINDS[kind], reliable=kept, kept=kept))
            for messages in network.receive(self.over.is_set):
                self.published |= {one.name: one.kind for one in network.topics().values()}
                for one in messages:
                    self.heard[one.topic].append(one)


@contextmanager
def listening():
    listener = Listener()
    listener.start()
    try:
        yield listener
    finally:
        listener.over.set()
        listener.join()


@contextmanager
def played(folder, *words):
    """Play a drive in another process, once somebody reads it; yields whether that is over."""
    command = [sys.executable, "-m", "tests.scenery.ros2_player", str(folder)]
    player = subprocess.Popen([*command, "--stand", "/diagnostics", *words], cwd=ROOT)
    try:
        yield lambda: player.poll() is not None
    finally:
        player.kill()
        player.wait()


def live(stopped, out, **how):
    with open_ros2("ros2:", SourceSettings(), stopped=stopped) as source:
        options = MapOptions(
            out=out, mesh=False, writers=[source.network], stamp_ns=source.stamp_ns
        )
        return run_live(source, load_config(), options, stopped=stopped, **how)


def poses(messages):
    """``T_parent_child`` by parent, child and stamp."""
    return {
        (one.parent, one.child, one.stamp_ns): make_transform(
            rotation_from_quaternion(one.xyzw), one.xyz_m
        )
        for message in messages
        for one in poses_of(message.parse(), 0)
    }


@pytest.fixture(autouse=True)
def _own_domain(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 200))


@pytest.fixture(scope="module")
def drive(street_film, tmp_path_factory):
    street = street_film.taken(slice(0, 8))
    folder = tmp_path_factory.mktemp("drive")
    write_kitti(street, folder)
    return folder


@pytest.fixture(scope="module")
def mapped(drive, tmp_path_factory):
    """What was heard while a drive was mapped, and who came after its last frame."""
    out = tmp_path_factory.mktemp("live") / "run"
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 200)
    # Slowly, as frames that a busy machine drops are in no cloud.
    with listening() as listener, played(drive, "--rate", "0.2") as over:
        summary = live(over, out)
    return listener, summary, out


def test_all_topics_of_the_page_are_published_and_no_others(mapped):
    listener, _, _ = mapped
    theirs = {
        f"/{side}/{what}" for side in ("left", "right") for what in ("image_raw", "camera_info")
    }
    kinds = {name: kind.rpartition("/")[2] for name, kind in listener.published.items()}
    assert len(promised()) == 9
    assert {name: kinds[name] for name in kinds.keys() - theirs} == promised()
    assert listener.heard.keys() - {"/left/camera_info"} == promised().keys()


def test_every_message_is_written_again_byte_for_byte(mapped):
    heard = mapped[0].heard
    for messages in heard.values():
        for one in messages:
            again = bytes(message_types().serialize_cdr(one.parse(), one.kind))
            assert one.content[: len(again)] == again


def test_the_tree_of_frames_is_whole_and_says_where_the_pose_is(mapped):
    heard = mapped[0].heard
    fixed, moving = poses(heard["/tf_static"]), poses(heard["/tf"])
    parents = {child: parent for parent, child, _ in (*fixed, *moving)}
    assert len({(parent, child) for parent, child, _ in (*fixed, *moving)}) == len(parents)
    for frame in ("left_rectified", "right_rectified", "left"):
        way = [frame]
        while way[-1] in parents:
            way.append(parents[way[-1]])
        assert way[-3:] == ["base_footprint", "odom", "map"]
    stamps = [stamp for parent, _, stamp in moving if parent == "map"]
    assert len(stamps) > 4
    found = {stamp_ns(one.parse()): one.parse().pose.pose for one in heard["/pose"]}
    for stamp in stamps:
        T = moving["map", "odom", stamp] @ moving["odom", "base_footprint", stamp]
        place = found[stamp].position
        np.testing.assert_allclose(T[:3, 3], [place.x, place.y, place.z], atol=1e-9)
    T_base_left = mount()[1][2]
    np.testing.assert_allclose(
        next(T for (_, child, _), T in fixed.items() if child == "left_rectified"),
        T_base_left,
        atol=1e-9,
    )


def test_stamps_are_those_of_images_to_the_nanosecond(mapped):
    heard = mapped[0].heard
    sent = {stamp_ns(one.parse()) for one in heard["/left/camera_info"]}
    for topic in ("/odometry", "/pose", "/tf"):
        for one in heard[topic]:
            message = one.parse()
            parts = getattr(message, "transforms", [message])
            assert {stamp_ns(part) for part in parts} <= sent


def test_grids_are_as_nav2_reads_them(mapped):
    heard = mapped[0].heard
    for topic in ("/map", "/costmap"):
        grid = heard[topic][-1].parse()
        assert grid.header.frame_id == "map"
        assert grid.info.width * grid.info.height == len(grid.data) > 0
        assert grid.info.resolution > 0
        assert grid.data.dtype == np.int8
        assert grid.data.min() >= -1
        assert grid.data.max() <= 100
        assert (grid.info.origin.orientation.w, grid.info.origin.orientation.z) == (1.0, 0.0)
    assert (heard["/map"][-1].parse().data == 0).any()


def test_diagnostics_say_how_late_poses_are(mapped):
    heard, summary = mapped[0].heard, mapped[1]
    said = [one.parse().status[0] for one in heard["/diagnostics"]]
    assert {one.level for one in said} <= {0, 1, 2}
    keys = {value.key: value.value for value in said[-1].values}
    assert float(keys["latency_p95_ms"]) > 0
    assert summary.to_json()["live"]["frames_arrived"] >= 8


def test_a_drive_is_found_in_a_map_and_who_comes_late_gets_the_grid(mapped, drive, tmp_path):
    late = []

    def join(over):
        """Begin to listen when the map has been published for long."""
        while not over():
            time.sleep(0.05)
        with closing(Network()) as network:
            network.subscribe(NetworkTopic("/map", KINDS["OccupancyGrid"], True, True))
            end_s = time.monotonic() + 60
            for messages in network.receive(lambda: bool(late) or time.monotonic() > end_s):
                late.extend(messages)

    # Slowly: a busy machine localises two frames a second, and frames that it drops are not found.
    with listening() as listener, played(drive, "--compressed", "--rate", "0.2") as over:
        joiner = threading.Thread(target=join, args=(over,), daemon=True)
        joiner.start()
        summary = live(
            lambda: over() and not joiner.is_alive(), tmp_path / "found", map_path=mapped[2]
        )
    assert summary.to_json()["frames_tracking"] > 3
    [grid] = [one.parse() for one in late]
    assert grid.info.width * grid.info.height == len(grid.data)
    moving = poses(listener.heard["/tf"])
    assert any(parent == "map" for parent, _, _ in moving)
    here = [T for (_, child, _), T in sorted(moving.items()) if child == "base_footprint"]
    steps = [np.linalg.norm((invert(a) @ b)[:3, 3]) for a, b in pairwise(here)]
    assert max(steps) < 3.0  # odom never jumps: the street is driven at 1 m a frame


def test_parameters_and_layouts_are_for_topics_that_there_are():
    folder = ROOT / "examples/robot"
    nav2 = yaml.safe_load((folder / "nav2.yaml").read_text())
    rviz = yaml.safe_load((folder / "recon.rviz").read_text())["Visualization Manager"]
    foxglove = json.loads((folder / "foxglove.json").read_text())["configById"]
    ours = promised()
    displays = [one["Topic"]["Value"] for one in rviz["Displays"] if "Topic" in one]
    static = nav2["global_costmap"]["global_costmap"]["ros__parameters"]["static_layer"]
    local = nav2["local_costmap"]["local_costmap"]["ros__parameters"]["obstacle_layer"]
    named = {
        *displays, *foxglove["3D!map"]["topics"], static["map_topic"], local["cloud"]["topic"],
        nav2["bt_navigator"]["ros__parameters"]["odom_topic"],
    }  # fmt: skip
    assert named - {"/left/image_raw"} <= ours.keys()
    assert {"/map", "/costmap", "/odometry", "/cloud", "/path"} <= named
