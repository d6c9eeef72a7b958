"""A robot's own static transforms say where its base is: below and behind its camera."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from recon.commands.config import load_config, run_settings
from recon.commands.export import run_export
from recon.commands.localize import run_localize
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.commands.merge import run_merge
from recon.core.geometry.se3 import exp_so3, invert, make_transform, rotation_from_quaternion
from recon.io.models.rasters import read_grid
from recon.io.trajectory import read_tum
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.map import Map
from recon.map.store.session import AXES
from recon.sources.registry import open_source
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.flow.runs import summary_of
from tests.scenery.made_once import made_once
from tests.sources.bags import TOPICS, Recording, recorder
from tests.sources.drives import stamp_ns

HEIGHT_M = 1.1
T_FOOTPRINT_CAM = make_transform(
    AXES_MAP_WORLD @ exp_so3(np.array([-np.deg2rad(20.0), 0.0, 0.0])), np.array([0.3, 0, HEIGHT_M])
)
"""20 degrees down, 1.1 m up and 0.3 m ahead."""
T_FOOTPRINT_LINK = make_transform(exp_so3(np.array([0, 0, 0.0])), np.array([0.1, 0.0, 0.25]))
T_LINK_CAM = invert(T_FOOTPRINT_LINK) @ T_FOOTPRINT_CAM
ROBOT = {"base_footprint__base_link": T_FOOTPRINT_LINK, "base_link__cam": T_LINK_CAM}
CONFIG = load_config(None, ["loops.enabled=false", "rig.refine=false", "scene.scale=0.5"])


@pytest.fixture(scope="module")
def driven():
    """Pairs of a camera on a robot on a straight road, and the camera."""
    size = {"width_px": 256, "height_px": 160, "focal_px": 150.0, "baseline_m": 0.3}
    drive = SyntheticSource(StreetScene(frames=10, path="straight", smooth_edges=False, **size))
    level = make_transform(AXES_MAP_WORLD, np.zeros(3))
    T_street_base = drive.world.T_street_camera @ invert(level)
    T_street_base[:, 2, 3] = 0.0
    drive.world = replace(drive.world, T_street_camera=T_street_base @ T_FOOTPRINT_CAM)
    return list(drive.frames()), drive.calibration


@pytest.fixture(scope="module")
def mapped(driven, tmp_path_factory):
    """The run of any robot, by its static transforms; it must not be changed."""

    def run(name, **edges):
        def make(out):
            # Of another drive than the others, so that they can be merged.
            first = 1 if name == "link" else 0
            source = open_source(record(driven, out.with_name(f"{name}_bag"), edges, first))
            run_map(source, CONFIG, MapOptions(audit=False, out=out, mesh=False))

        return made_once(tmp_path_factory, name, make)

    return run


def record(driven, folder: Path, edges: dict[str, np.ndarray], first: int = 0) -> Path:
    """Write a bag; ``edges`` are static transforms by PARENT__CHILD."""
    pairs, camera = driven
    how = Recording("mcap")
    with recorder(folder, how) as bag:
        for pair in pairs[first:]:
            stamp = stamp_ns(pair)
            parts = [bag.transform(stamp, *name.split("__"), T) for name, T in edges.items()]
            bag.write("/tf_static", stamp, bag.transforms(*parts))
            bag.camera_infos(stamp, camera)
            for topic, image in zip(TOPICS, (pair.left, pair.right), strict=True):
                bag.write(topic, stamp, bag.image(stamp, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)))
    return how.path(folder)


def check_base(run: Path, T_base_camera: np.ndarray) -> None:
    """The path of the base is that of the camera, moved as the robot says."""
    summary, base = summary_of(run), read_tum(run / "trajectory_map_base_tum.txt")
    camera = read_tum(run / "trajectory_tum.txt")
    T_map_camera = np.array(summary["T_map_world"]) @ camera.T_world_camera
    np.testing.assert_allclose(base.T_world_camera @ T_base_camera, T_map_camera, atol=1e-8)


def edges_of(bag: Path, topic: str) -> dict[tuple[str, str], np.ndarray]:
    """The first transforms of a topic, by the names of parent and child."""
    found = {}
    with AnyReader([bag]) as reader:
        of = [one for one in reader.connections if one.topic == topic]
        for connection, _, content in reader.messages(of):
            for part in reader.deserialize(content, connection.msgtype).transforms:
                t, q = part.transform.translation, part.transform.rotation
                T = make_transform(rotation_from_quaternion([q.x, q.y, q.z, q.w]), [t.x, t.y, t.z])
                found.setdefault((part.header.frame_id, part.child_frame_id), T)
    return found


def test_path_grid_and_bag_are_those_of_a_base_on_the_ground(mapped, tmp_path):
    run = mapped("footprint", **ROBOT)
    summary = summary_of(run)
    assert summary["base_frame"] == "base_footprint"
    assert summary["camera_height_m"] == pytest.approx(HEIGHT_M, abs=1e-12)
    np.testing.assert_allclose(summary["T_base_camera"], T_FOOTPRINT_CAM, atol=1e-12)
    # The map is levelled and headed by the base, and begins at the camera.
    np.testing.assert_allclose(
        np.array(summary["T_map_world"])[:3, :3], T_FOOTPRINT_CAM[:3, :3], atol=1e-12
    )
    check_base(run, T_FOOTPRINT_CAM)
    base = read_tum(run / "trajectory_map_base_tum.txt")
    start = make_transform(np.eye(3), -T_FOOTPRINT_CAM[:3, 3])
    np.testing.assert_allclose(base.T_world_camera[0], start, atol=1e-8)
    driven_m = base.positions_m[-1] - base.positions_m[0]
    assert driven_m[0] > 7
    assert np.abs(driven_m[1:]).max() < 0.05 * driven_m[0]
    grid = read_grid(run / "map/grid.yaml")
    # The robot stands on free cells; what it has below and before it is no obstacle.
    cells = np.floor((base.positions_m[:, :2] - grid.origin_m) / grid.resolution_m).astype(int)
    assert (grid.cells[cells[:, 1], cells[:, 0]] == 0).all()
    # Products made later know it from the map.
    out = tmp_path / "out"
    run_export(run, products=["mcap", "grid"], out=out)
    assert summary_of(out)["T_base_camera"] == summary["T_base_camera"]
    fixed, moving = (edges_of(out / "bag", topic) for topic in ("/tf_static", "/tf"))
    np.testing.assert_allclose(fixed["base_footprint", "left"], T_FOOTPRINT_CAM, atol=1e-9)
    np.testing.assert_allclose(moving["map", "base_footprint"], start, atol=1e-7)
    assert '"followTf": "base_footprint"' in (out / "bag/foxglove.json").read_text()


def test_the_height_of_a_base_link_is_measured(mapped):
    run = mapped("link", base_link__cam=T_LINK_CAM)
    summary = summary_of(run)
    assert summary["base_frame"] == "base_link"
    np.testing.assert_allclose(summary["T_base_camera"], T_LINK_CAM, atol=1e-12)
    assert summary["camera_height_m"] == pytest.approx(HEIGHT_M, abs=0.05)
    assert summary["camera_height_m"] != T_LINK_CAM[2, 3]
    check_base(run, T_LINK_CAM)


def test_a_height_that_the_ground_contradicts_is_said(mapped):
    raised = make_transform(T_FOOTPRINT_CAM[:3, :3], np.array([0.3, 0.0, HEIGHT_M + 0.25]))
    summary = summary_of(mapped("raised", base_footprint__cam=raised))
    (said,) = [text for text in summary["warnings"] if "static transforms" in text]
    assert said.startswith(
        "the static transforms put the camera 1.35 m above the ground, and it is"
    )
    assert summary["camera_height_m"] == pytest.approx(HEIGHT_M, abs=0.05)
    np.testing.assert_allclose(summary["T_base_camera"], raised, atol=1e-12)


def test_a_height_that_is_set_wins(mapped, tmp_path):
    run = mapped("footprint", **ROBOT)
    settings = run_settings(run, None, ["ground.camera_height_m=1.06"])
    run_export(run, settings, products=["grid"], out=tmp_path)
    summary = summary_of(tmp_path)
    assert summary["camera_height_m"] == 1.06
    np.testing.assert_allclose(summary["T_base_camera"], T_FOOTPRINT_CAM, atol=1e-12)


def test_transforms_that_no_robot_can_have_change_nothing_and_are_said(mapped):
    """A camera whose axes are those of its base looks at the sky: it is no optical frame."""
    none, wrong = mapped("none"), mapped("wrong", base_link__cam=np.eye(4))
    (said,) = [text for text in summary_of(wrong)["warnings"] if "not used" in text]
    assert said.startswith("base_link does not stand on the ground that is seen")
    for name in ("trajectory_map_base_tum.txt", "map/grid.pgm", "map/cloud.ply"):
        assert (wrong / name).read_bytes() == (none / name).read_bytes()
    for run in (none, wrong):
        assert "base_frame" not in summary_of(run)
        with Map.open(run) as map_:
            assert map_.store.get(AXES, 0).keys() == {"T_map_world", "camera", "level"}


def test_another_robot_is_located_by_its_own_base(driven, mapped, tmp_path):
    run = mapped("footprint", **ROBOT)
    other = make_transform(T_LINK_CAM[:3, :3], np.array([-0.2, 0.4, 0.6]))
    for edges, T, name in (
        ({"base_link__cam": other}, other, "base_link"),
        ({}, T_FOOTPRINT_CAM, "base_footprint"),  # of the map, as far as is known
    ):
        out = tmp_path / name
        source = open_source(record(driven, tmp_path / f"{name}_bag", edges))
        found = run_localize(source, run, CONFIG, MapOptions(audit=False, out=out, bag=True))
        assert found.summary.base_frame == name
        assert len(found.drive.tracked) > 5
        check_base(out, T)
        fixed = edges_of(out / "bag", "/tf_static")
        np.testing.assert_allclose(fixed[name, "cam_rectified"], T, atol=1e-9)


def test_each_drive_of_a_map_has_the_base_of_its_robot(mapped, tmp_path):
    runs = [mapped("footprint", **ROBOT), mapped("link", base_link__cam=T_LINK_CAM)]
    run_merge(runs, None, MapOptions(out=tmp_path / "both", mesh=False))
    run_export(tmp_path / "both", products=["mcap"], out=tmp_path / "out")
    fixed = edges_of(tmp_path / "out/bag", "/tf_static")
    np.testing.assert_allclose(
        fixed["drive0/base_footprint", "drive0/left"], T_FOOTPRINT_CAM, atol=1e-9
    )
    np.testing.assert_allclose(fixed["drive1/base_link", "drive1/left"], T_LINK_CAM, atol=1e-9)
