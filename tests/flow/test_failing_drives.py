"""A drive on which every method fails says so, loudly, and maps nothing of it.

A motorway with next to nothing on it: lines that look alike wherever the camera is along them, a
rail, grey asphalt, sky. kiss-icp stands still on it and is sure of that.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.evaluate import run_evaluate_map, run_evaluate_trajectory
from recon.commands.export import run_export, run_mesh, run_occupancy
from recon.commands.localize import run_localize
from recon.commands.map import MapResult, run_map
from recon.commands.map_options import MapOptions
from recon.commands.merge import run_merge, run_remove
from recon.core.errors import CalibrationError, MappingError, RegistrationError
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import PointCloud, RectifiedCamera, RectifiedPair, Trajectory
from recon.evaluation.trajectory import TrajectoryRules
from recon.map.drive.sequence import check_map
from recon.odometry.protocol import OdometryFrame
from recon.odometry.registry import make_odometry
from recon.sources.registry import open_source
from recon.stereo.match.registry import make_matcher
from tests.flow.runs import summary_of
from tests.sources import drives

Pairs = list[RectifiedPair]
CAMERA = RectifiedCamera(260.0, 199.5, 60.5, 199.5, 0.54, 400, 130)
HEIGHT_M = 1.65
TEXELS_PER_M = 40.0


RNG = np.random.default_rng(1)
FINE, COARSE = (
    cv2.GaussianBlur(RNG.normal(size=(1024, 1024)), (0, 0), size) for size in (1.5, 12.0)
)
GRAIN = (0.7 * FINE / FINE.std() + 0.7 * COARSE / COARSE.std()).astype(np.float32)


@dataclass(frozen=True)
class Road:
    grain: float  # standard deviation of the asphalt, grey values
    step_m: float  # way from frame to frame
    dark: tuple[int, ...] = ()  # frames in which next to no light is left
    blurred: tuple[int, ...] = ()  # frames that the camera shook through

    def pose(self, index: int) -> np.ndarray:
        step = make_transform(
            exp_so3(np.array([0.0, 0.006, 0.0])), np.array([0.0, 0.0, self.step_m])
        )
        return np.linalg.matrix_power(step, index)

    def pairs(self, frames: Iterable[int]) -> Pairs:
        return [self.pair(index) for index in frames]

    def pair(self, index: int) -> RectifiedPair:
        T_world_left = self.pose(index)
        T_left_right = make_transform(np.eye(3), np.array([CAMERA.baseline_m, 0.0, 0.0]))
        poses = (T_world_left, T_world_left @ T_left_right)
        left, right = (self._image(T, index, side) for side, T in enumerate(poses))
        return RectifiedPair(left, right, CAMERA, timestamp_s=0.1 * index, index=index)

    def _image(self, T_world_camera: np.ndarray, index: int, side: int) -> np.ndarray:
        thirds = (-1 / 3, 0.0, 1 / 3)
        light = np.mean(
            [_look(T_world_camera, du, dv, self.grain) for du in thirds for dv in thirds], axis=0
        )
        # A lens is not sharper than its pixels: stairs along lines would look like corners.
        light = cv2.GaussianBlur(light, (0, 0), 0.7)
        if index in self.blurred:
            light = cv2.blur(light, (61, 1))
        light *= 0.02 if index in self.dark else 1.0
        noise = np.random.default_rng([index, side]).normal(0.0, 2.0, light.shape)
        return np.clip(np.rint(light + noise), 0, 255).astype(np.uint8)


def _look(T_world_camera: np.ndarray, du: float, dv: float, grain: float) -> np.ndarray:
    """Light (H, W) along one ray of each pixel: sky, road, lines, and the beam of the rail."""
    v, u = np.mgrid[0 : CAMERA.height_px, 0 : CAMERA.width_px].astype(np.float64)
    x, y = ((u + du - CAMERA.cx_px), (v + dv - CAMERA.cy_px))
    rays = np.stack([x / CAMERA.focal_px, y / CAMERA.focal_px, np.ones_like(x)], axis=-1)
    rays = rays @ T_world_camera[:3, :3].T
    start = T_world_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (HEIGHT_M - start[1]) / rays[..., 1]
        aside = (8.0 - start[0]) / rays[..., 0]
    road = (far > 0) & (far < 400)
    side, along = (
        np.where(road, start[k] + np.where(road, far, 0) * rays[..., k], 0) for k in (0, 2)
    )
    places = ((TEXELS_PER_M * k % 1023).astype(np.float32) for k in (side, along))
    # Grain that is finer than a pixel is averaged away.
    asphalt = cv2.remap(GRAIN, *places, cv2.INTER_LINEAR) * np.clip(12 / far, 0, 1)
    light = np.where(road, 95 + grain * asphalt, 200 - 30 * np.clip(-rays[..., 1], 0, 1))
    light[road & (np.abs(np.abs(side) - 2.0) < 0.07) & (along % 18 < 6)] = 200
    light[road & (np.abs(np.abs(side) - 6.0) < 0.1)] = 205
    height = start[1] + aside * rays[..., 1]
    beam = (aside > 0) & (aside < np.where(road, far, 300)) & (height > 0.95) & (height < 1.25)
    light[beam] = 150
    return light


ROAD = Road(grain=25.0, step_m=0.8)
BARE = Road(grain=1.0, step_m=2.8)
ALLOWED_M = 0.05 * 9 * 0.8
"""Undisturbed, the drive ends 0.26 m off, 4 % of its length: such a road gives few features."""
BODY = make_transform(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))


@pytest.fixture(scope="module")
def seen():
    return ROAD.pairs(range(10))


def map_drive(pairs, folder, *settings, baseline=1, **more):
    """Map pairs as a drive in KITTI's layout, with a calibration that may be wrong."""
    frames = [replace(pair, index=index) for index, pair in enumerate(pairs)]
    drives.write_kitti(frames, CAMERA, folder / "drive")
    source = open_source(folder / "drive")
    wrong = replace(source, calibration=replace(CAMERA, baseline_m=baseline * CAMERA.baseline_m))
    options = MapOptions(**{"audit": False, "out": folder / "out", "mesh": False, **more})
    return run_map(source if baseline == 1 else wrong, load_config(None, settings), options)


def doubted(run: MapResult) -> list[int]:
    return [index for index, record in enumerate(run.mapped.health) if not record.ok]


def off_m(run: MapResult, road: Road, index: int) -> float:
    """Distance of the end of the path to where frame ``index`` was taken."""
    truth = road.pose(index)[:3, 3]
    return float(np.linalg.norm(run.mapped.trajectory.positions_m[-1] - truth))


def dimmed(pair: RectifiedPair, factor: float) -> RectifiedPair:
    left, right = ((factor * image).astype(np.uint8) for image in (pair.left, pair.right))
    return replace(pair, left=left, right=right)


def test_a_drive_without_a_map_says_why(seen, tmp_path):
    swapped = [replace(pair, left=pair.right, right=pair.left) for pair in seen[:3]]
    with pytest.raises(MappingError, match=r"the map is empty: 8 of 8 poses are not to be"):
        map_drive(BARE.pairs(range(8)), tmp_path / "bare")
    with pytest.raises(MappingError, match=r"no point in the middle of the drive: .* at .* m"):
        map_drive(seen[:4], tmp_path / "near", "cloud.max_range_m=0.5")
    with pytest.raises(CalibrationError, match="left and right images are swapped"):
        map_drive(swapped, tmp_path / "swapped")
    assert [path.name for path in tmp_path.glob("*/*")] == ["drive"] * 3


def test_an_empty_map_of_frames_that_share_no_place_is_told_in_one_sentence(seen):
    sample = SimpleNamespace(cloud=PointCloud(np.full((3, 3), 2.0, np.float32)))
    mapped: Any = SimpleNamespace(tiles=[], health=[], config=load_config(), sample=sample)
    mapped.camera, mapped.trajectory = seen[0].camera, range(6)
    with pytest.raises(
        MappingError, match=r"^a: the map is empty: of 6 frames, too few saw .*; use"
    ):
        check_map(mapped, "a")


def test_a_baseline_in_another_unit_is_warned_of_and_throws_nothing_away(seen, tmp_path):
    run = map_drive(seen[:4], tmp_path, baseline=1000, audit=True)
    assert "baseline is unusual: 540 m" in " ".join(run.warnings)
    assert run.summary.to_json()["scale"] == 1000.0
    assert len(run.cloud)


def body_path(change: Callable[[np.ndarray], np.ndarray] = np.copy) -> Trajectory:
    """The path of `ROAD`, as wheels would give it, with other positions."""
    poses = np.stack([ROAD.pose(index) @ BODY for index in range(10)])
    poses = np.linalg.inv(poses[0]) @ poses
    poses[:, :3, 3] = change(poses[:, :3, 3])
    return Trajectory(poses, 0.1 * np.arange(10))


def test_a_prior_in_body_axes_is_recognised(seen, tmp_path):
    run = map_drive(seen, tmp_path, prior=body_path())
    assert not doubted(run)
    told = run.summary.to_json()["prior"]
    assert (told["axes"], told["known_from"]) == ("body", "images")
    assert told["sigmas"]["camera"] > 5
    assert off_m(run, ROAD, 9) < ALLOWED_M


@pytest.mark.parametrize(
    ("axes", "change"),
    [("camera", np.copy), ("auto", lambda xyz: 1e3 * xyz), ("body", lambda xyz: 1e-3 * xyz)],
)
def test_a_prior_that_contradicts_the_images_is_refused(seen, tmp_path, axes, change):
    with pytest.raises(RegistrationError, match="the prior does not fit what the cameras see"):
        map_drive(seen, tmp_path, f"odometry.prior.axes={axes}", prior=body_path(change))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("grain", "seen"), [(1.0, False), (25.0, True)])
def test_what_kiss_icp_is_sure_of_is_believed_where_the_image_agrees(grain, seen):
    """Where visual odometry sees nothing to begin from, either, nothing goes on from before."""
    matcher, odometry = make_matcher("sad"), make_odometry("kiss")
    pairs = Road(grain=grain, step_m=0.8).pairs(range(5))
    results = [odometry.register(OdometryFrame(pair, matcher.match(pair))) for pair in pairs]
    way_m = np.linalg.norm(results[-1].T_world_camera[:3, 3])
    assert bool(abs(way_m - 4 * 0.8) < 0.1) is seen
    health = [result.health for result in results]
    assert sum(one.ok and not one.begins for one in health) == (5 if seen else 1)


def test_a_road_with_texture_is_believed_where_it_is_seen(tmp_path):
    """Two dark frames and two that the camera shook through; sight comes back between them.

    The first sharp frame after a blurred one has nothing that looks like it to be compared with.
    """
    road = replace(ROAD, dark=(4, 5), blurred=(9, 10))
    run = map_drive(road.pairs(range(14)), tmp_path)
    assert {4, 5} <= set(doubted(run)) <= {4, 5, 9, 10, 11}
    # The dark frames are bridged by what was seen before and after.
    assert off_m(run, road, 13) < 0.03 * 13 * 0.8
    assert len(run.cloud) > 1000


def test_missing_frames_and_a_jump_of_exposure_are_bridged(seen, tmp_path):
    run = map_drive([*seen[:4], *seen[7:9], dimmed(seen[9], 0.5)], tmp_path)
    assert run.warnings == ()
    assert off_m(run, ROAD, 9) < ALLOWED_M


def test_one_frame_makes_a_map(seen, tmp_path):
    run = map_drive(seen[:1], tmp_path)
    np.testing.assert_array_equal(run.mapped.trajectory.T_world_camera, np.eye(4)[None])
    # The camera does not see the ground that it stands on.
    (warning,) = run.warnings
    assert warning.startswith("no ground was found below the path")
    assert (tmp_path / "out" / "map" / "grid.yaml").is_file()


def test_where_nothing_says_how_a_drive_went_on_another_submap_begins(seen, tmp_path):
    pairs = [*seen[:2], dimmed(seen[2], 0), *seen[3:6], *ROAD.pairs(range(60, 64))]
    run = map_drive(pairs, tmp_path)
    assert doubted(run) == [2]
    assert run.mapped.health[2].skipped
    assert [n for n, record in enumerate(run.mapped.health) if record.begins] == [6]
    assert [entry.first_frame for entry in run.mapped.session.submaps.entries] == [0, 6]
    assert [(one.first, one.joined) for one in run.mapped.segments] == [(0, True), (6, False)]


@pytest.fixture(scope="module")
def runs(seen, tmp_path_factory):
    """A run that ends on a bare road, and one that does not, of the same road."""
    root = tmp_path_factory.mktemp("runs")
    bad = map_drive([*seen[:8], *BARE.pairs(range(10, 14))], root / "bad")
    assert doubted(bad) == [8, 9, 10, 11]
    assert bad.warnings[1].startswith("frames 8-11: the pose is not to be trusted")
    assert _said(bad.summary.to_json(), root / "bad" / "out") == bad.warnings[0]
    assert bad.summary.to_json()["frames_not_trusted"] == 4
    map_drive(seen[4:], root / "good")
    return root


DOUBT = "4 of 12 poses are not to be trusted (frames 8-11): nothing of them is in the map"
"""They were skipped, so that the path of the others is none the worse."""


def _said(summary: dict[str, Any], out: Path) -> str:
    """The first warning of a run, which its record has, too."""
    assert summary["warnings"] == summary_of(out)["warnings"]
    return str(summary["warnings"][0])


def test_every_later_command_says_that_poses_are_doubted(runs, tmp_path):
    bad, good = runs / "bad" / "out", runs / "good" / "out"
    cloud, path, rules = good / "map" / "cloud.ply", "trajectory_tum.txt", TrajectoryRules()
    out = {name: tmp_path / name for name in ("export", "mesh", "occupancy", "found")}
    alone = [
        _said(
            run_export(bad, products=["cloud", "grid"], out=out["export"]).to_json(), out["export"]
        ),
        _said(run_occupancy(bad, out=out["occupancy"]).to_json(), out["occupancy"]),
        _said(run_mesh(bad, load_config(), out=out["mesh"]).to_json(), out["mesh"]),
        # A run without a map of its own knows it from the run that it was made from.
        run_evaluate_map(out["export"], cloud).to_json()["warnings"][0],
        run_evaluate_map(bad, cloud).to_json()["warnings"][0],
        run_evaluate_trajectory(bad / path, good / path, rules).to_json()["warnings"][0],
    ]
    drive = open_source(runs / "good" / "drive")
    options = MapOptions("localize", out["found"])
    alone.append(_said(run_localize(drive, bad, options=options).summary.to_json(), out["found"]))
    for line in alone:
        assert line.startswith(DOUBT)


def test_a_merged_map_says_which_drive_is_doubted(runs, tmp_path):
    out, parts = tmp_path / "merged", [runs / name / "out" for name in ("good", "bad")]
    merged = run_merge(parts, options=MapOptions("merge", out, mesh=False)).to_json()
    assert _said(merged, out).startswith(f"session 1 (drive): {DOUBT}")
    assert [one["frames_not_trusted"] for one in merged["sessions"]] == [0, 4]
    assert [one["frames_placed"] for one in merged["sessions"]] == [6, 8]
    assert DOUBT in (out / "report.html").read_text()
    after = run_remove(out, 0, None, MapOptions(mesh=False)).to_json()
    assert after["warnings"][0].startswith(DOUBT)
