"""A prior of the motion is read from a file, or from a topic of the recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import ReconError
from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import RectifiedCamera
from recon.sources.registry import open_source
from tests.sources import drives

pytest.importorskip("rosbags", reason="extra ros")
from tests.sources.bags import TOPICS, Recording, recorder

CAMERA = RectifiedCamera(60.0, 31.5, 15.5, 31.5, 0.5, 64, 32)
START_NS = drives.EPOCH_S * 10**9
# The camera sits 1 m ahead and 0.4 m up, looks ahead and is tilted; by way of a bracket.
T_BASE_BRACKET = make_transform(np.eye(3), np.array([1.0, 0.0, 0.0]))
T_BRACKET_CAM = make_transform(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) @ exp_so3([0.2, 0.0, 0.0]),
    np.array([0.0, 0.0, 0.4]),
)


def base(index: int) -> np.ndarray:
    step = make_transform(exp_so3(np.array([0.0, 0.0, 0.05])), np.array([0.3, 0.0, 0.0]))
    return np.linalg.matrix_power(step, index)


def write(folder: Path, kind: str, *, static: bool = True) -> Path:
    """Three pairs, with odometry, transforms and a topic of another type."""
    how = Recording(kind)
    with recorder(folder, how) as bag:
        if static:
            parts = [
                # The second one the other way round, as some publishers have it.
                bag.transform(START_NS, "base_link", "bracket", T_BASE_BRACKET),
                bag.transform(START_NS, "cam", "bracket", invert(T_BRACKET_CAM)),
            ]
            bag.write("/tf_static", START_NS, bag.transforms(*parts))
        for index in range(3):
            stamp = START_NS + index * 10**8
            moved = bag.transform(stamp, "odom", "base_link", base(index))
            wheel = bag.transform(stamp, "base_link", "wheel", base(index))
            bag.write("/tf", stamp, bag.transforms(moved, wheel))
            bag.write("/odom", stamp, bag.odometry(stamp, base(index)))
            for topic, P in zip(TOPICS, drives.projections(CAMERA), strict=True):
                name = topic.rsplit("/", 1)[0] + "/camera_info"
                bag.write(name, stamp, bag.camera_info(stamp, CAMERA, P))
                bag.write(topic, stamp, bag.image(stamp, np.full((32, 64), index, np.uint8)))
    path = folder / how.name
    return next(path.glob("*.mcap")) if kind == "mcap" else path


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
@pytest.mark.parametrize("topic", ["/odom", "/tf"])
def test_odometry_of_a_bag_becomes_the_path_of_its_camera(
    tmp_path: Path, kind: str, topic: str
) -> None:
    found = open_source(write(tmp_path, kind)).read_prior(topic)
    T_base_camera = T_BASE_BRACKET @ T_BRACKET_CAM
    expected = np.stack([base(index) @ T_base_camera for index in range(3)])
    # Quaternions of unit length to 16 digits.
    np.testing.assert_allclose(found.path.T_world_camera, expected, atol=1e-12)
    np.testing.assert_allclose(
        found.path.timestamps_s, drives.EPOCH_S + 0.1 * np.arange(3), atol=1e-6
    )
    assert found.origin == (
        f"{topic}, 3 poses of base_link in odom, moved to cam by the static transforms"
    )


def test_without_static_transforms_the_poses_stay_those_of_the_body(tmp_path: Path) -> None:
    found = open_source(write(tmp_path, "ros1", static=False)).read_prior("/odom")
    np.testing.assert_allclose(found.path.T_world_camera[2], base(2), atol=1e-12)
    assert "no static transform to cam" in found.origin


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_topics_that_are_not_used_are_reported(tmp_path: Path, kind: str) -> None:
    description = open_source(write(tmp_path, kind)).description
    assert "not used: /odom, /tf, /tf_static (for --prior: /odom, /tf)" in description


@pytest.mark.parametrize("others", [20, 21])
def test_of_many_topics_the_first_are_named(tmp_path: Path, others: int) -> None:
    with recorder(tmp_path, Recording("ros1")) as bag:
        for topic, P in zip(TOPICS, drives.projections(CAMERA), strict=True):
            name = topic.rsplit("/", 1)[0] + "/camera_info"
            bag.write(name, START_NS, bag.camera_info(START_NS, CAMERA, P))
            bag.write(topic, START_NS, bag.image(START_NS, np.zeros((32, 64), np.uint8)))
        for number in range(others):
            topic = f"/wheel{number:02d}"
            bag.write(topic, START_NS, bag.odometry(START_NS, np.eye(4)))
    listed = open_source(tmp_path / "drive.bag").description.partition("not used: ")[2]
    assert ("/wheel19 …" in listed) == (others > 20)
    assert "/wheel19" in listed.partition(" (for --prior")[0]


def test_a_topic_that_is_no_prior_is_refused_with_those_that_are(tmp_path: Path) -> None:
    source = open_source(write(tmp_path, "ros1"))
    for name in (TOPICS[0], "/wheels"):
        with pytest.raises(ReconError, match=r"no such topic of poses.*expected /odom \(3\), /tf"):
            source.read_prior(name)


def test_a_file_is_read_for_any_source(tmp_path: Path) -> None:
    path = tmp_path / "wheels.txt"
    path.write_text("0 0 0 0 0 0 0 1\n1 0 0 2 0 0 0 1\n")
    found = open_source(write(tmp_path / "bag", "ros1")).read_prior(str(path))
    assert found.path.path_length_m == 2
    assert found.origin == str(path)
