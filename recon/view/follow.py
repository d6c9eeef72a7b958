"""The scene of a map: of a finished run in full, of one that is being made as far as it is."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from recon.core.errors import ReconError
from recon.core.geometry.se3 import apply, invert
from recon.core.text import counted
from recon.core.values import PointCloud, RectifiedCamera, join_clouds
from recon.core.values.arrays import Float32, Float64, UInt8
from recon.core.values.camera import project, unproject
from recon.export.control import SURVEYED_M, Sighting, locate, sighted, triangulate
from recon.export.growing import submap_cloud
from recon.export.product import open_images
from recon.io.files import read_text, reading
from recon.io.models.mesh import read_mesh
from recon.io.models.rasters import read_grid
from recon.map.ground.grid import flatten
from recon.map.ground.surface import GroundSurface, estimate_ground_surface
from recon.map.localize.localizer import State
from recon.map.map import Map
from recon.map.sessions.measured import Survey
from recon.map.sessions.placed import settings_of
from recon.map.store.map_file import MapViews
from recon.report.scene import Points, Scene, thin_mesh
from recon.report.style import REASON_LABELS, colour_disparity, colour_reasons, hatch
from recon.run.directory import state_folder
from recon.run.finished import GRID, STATES, states_of
from recon.run.run import SUMMARY
from recon.sources.source import StereoSource
from recon.stereo.frame import FrameReconstructor

_MOST_FACES: Final = 400_000
# Not to be trusted, trusted but without a place in the map, in the map.
_TRUST: Final = np.array([(229, 57, 53), (255, 167, 38), (67, 200, 90)], np.uint8)
_LOCATED: Final = 9  # number of a located drive among those of a map, for its colour
_BEHIND_PX: Final = 1.0  # less disparity than was matched there: a place is hidden


def finish(run: Path, scene: Scene, survey: Survey | None = None) -> Iterator[Scene]:
    """Add to what the files of a finished run show what its map knows, step by step."""
    map_ = Map.open(run)  # as long as its keyframes are looked at
    named = ((one.number, one.info.source, one.date.text[:10]) for one in map_.linked)
    drives = [f"Drive {number}: {name} {date}".rstrip() for number, name, date in named]
    views, lines = KeyframeViews(map_, survey), [*scene.lines, *drives]
    scene = replace(scene, paths=_paths(map_), keyframes=views, lines=lines)
    yield scene
    if scene.points and (grid := run / GRID).is_file():
        scene = replace(scene, grids=((read_grid(grid), _ground(map_, scene)),))
    file = run / "mesh" / "mesh.ply"
    mesh = thin_mesh(read_mesh(file), _MOST_FACES) if file.is_file() else None
    yield replace(scene, mesh=mesh, points=_dated(scene.points, scene.paths))


def _ground(map_: Map, scene: Scene) -> GroundSurface:
    """Return the ground below the paths of a map, by its points."""
    settings, gap = settings_of(map_.first), np.full((1, 3), np.nan)
    pieces = [piece for path in scene.paths for piece in (path.cloud.xyz, gap)]
    clouds = (part.cloud for part in scene.points)
    cloud = join_clouds(PointCloud(c.xyz, normals=c.normals, frame="map") for c in clouds)
    reach_m = settings.occupancy.max_range_m
    return estimate_ground_surface(cloud, np.concatenate(pieces), settings.ground, reach_m)


def _paths(map_: Map) -> tuple[Points, ...]:
    placed, paths = map_.placed, []
    for drive in map_.linked:
        path, number = drive.trajectory, drive.number
        xyz = apply(drive.T_map_world, path.positions_m).astype(np.float32)
        rgb = _TRUST[drive.trusted.astype(np.int64) + placed[number]]
        paths.append(Points(f"{number}", _seen(xyz, rgb, path.timestamps_s, number)))
    return tuple(paths)


def follow_located(scenes: Iterable[Scene], run: Path) -> Iterator[Scene | None]:
    """Add to scenes of a map what a run located in it; if it still does, as long as that lasts."""
    for scene in scenes:
        yield add_located(scene, run)
    before, growing = 0, state_folder(run) / STATES
    while growing.is_file():
        new = None
        with suppress(OSError, ReconError):  # it may be about to be moved
            if (now := growing.stat().st_size) != before:
                before, new = now, add_located(scene, run)
        yield new
    if before and (run / STATES).is_file():  # else it was given up
        yield add_located(scene, run)


def add_located(scene: Scene, run: Path) -> Scene:
    """Add the path of a drive that a run located, by its table of states so far."""
    table = states_of(run)
    with reading(table):
        rows = [*csv.DictReader(read_text(table).rpartition("\n")[0].splitlines())]
        found = [row for row in rows if row["x_m"]]
        xyz = np.array([[float(row[name]) for name in ("x_m", "y_m", "z_m")] for row in found])
        times_s = [float(row["time_s"]) for row in found]
        T_map_world = np.array(json.loads(read_text(table.with_name(SUMMARY)))["T_map_world"])
    trust = [2 if row["state"] == State.TRACKING.value else 1 for row in found]
    xyz = apply(T_map_world, xyz.reshape(-1, 3)).astype(np.float32)
    path = Points("located", _seen(xyz, _TRUST[trust], np.array(times_s), _LOCATED))
    lines = [*scene.lines, f"{run}: {len(found)} of {counted(len(rows), 'frame')} located"]
    return replace(scene, lines=lines, paths=(*scene.paths, path))


def _seen(xyz: Float32, rgb: UInt8, times_s: Float64, number: int) -> PointCloud:
    """Return where the camera of a drive was, and when in the drive."""
    ages_s = (times_s - times_s[:1]).astype(np.float32)
    return PointCloud(xyz, rgb, time_s=ages_s, session=np.full(len(xyz), number, np.int32))


def _dated(parts: Sequence[Points], paths: Sequence[Points]) -> tuple[Points, ...]:
    """Return points with the time and the drive that passed nearest to each."""
    path = join_clouds(path.cloud for path in paths)
    near = cKDTree(path.xyz)

    def dated(cloud: PointCloud) -> PointCloud:
        nearest = path.select(near.query(cloud.xyz, workers=-1)[1])
        return replace(cloud, time_s=nearest.time_s, session=nearest.session)

    return tuple(replace(part, cloud=dated(part.cloud)) for part in parts)


def grow(run: Path, path: Path) -> Iterator[Scene | None]:
    """Yield the scene of an unfinished map after each commit until it is gone; None = as it was."""
    taken: list[Scene] = []
    before, now, log = 0, 0, Path(f"{path}-wal")  # SQLite's, of a map that is being written
    while path.is_file():
        before = now
        with suppress(OSError, ReconError):  # it may be about to be closed
            now = log.stat().st_mtime_ns
            if now != before:
                yield _snapshot(run, path, taken)
        yield None


def _snapshot(run: Path, path: Path, taken: list[Scene]) -> Scene:
    with Map.open(path) as map_:
        drive = map_.first
        taken += [_submap(map_, number) for number in range(len(taken), len(drive.submaps))]
        lines = [str(run), f"frame {len(drive)} of {drive.info.frames}, it is being mapped"]
        points = tuple(part for one in taken for part in one.points)
        grids = tuple(grid for one in taken for grid in one.grids)
        spacing_m = settings_of(drive).fusion.voxel_m
        return Scene(points, paths=_paths(map_), grids=grids, lines=lines, spacing_m=spacing_m)


def _submap(map_: Map, number: int) -> Scene:
    drive, settings = map_.first, settings_of(map_.first)
    submap, T = drive.submaps[number], drive.T_map_world
    cloud = submap_cloud(drive, submap)
    if not len(cloud) or not len(submap.occupancy):
        return Scene()
    voxels = submap.occupancy.voxels(settings.occupancy.resolution_m)
    path_m = apply(T, drive.odometry.positions_m[submap.first_frame :][: submap.frames])
    ground = estimate_ground_surface(cloud, path_m, settings.ground, settings.occupancy.max_range_m)
    points = _dated([Points(f"{number}", cloud)], _paths(map_))
    return Scene(points, grids=((flatten(voxels, ground, settings.grid), ground),))


class KeyframeViews:
    """The keyframes that have a place in a map; disparities and images are read when asked for.

    ``points``: the control points of a survey, by its name each (3,), map axes.
    """

    def __init__(self, map_: Map, survey: Survey | None = None) -> None:
        self._map, self._views = map_, MapViews(map_)
        self.points: Mapping[str, Float64] = {}
        self._marks: dict[str, dict[int, Sighting]] = {}  # by keyframe, of each control point
        if survey is not None and survey.control is not None:
            self._T_survey_map = locate(map_, survey, (), None).T_survey_map
            T, points = invert(self._T_survey_map), survey.control.points
            self.points = {one.name: apply(T, one.place_m[None])[0] for one in points}
        self._opened: dict[int, tuple[StereoSource, FrameReconstructor]] = {}
        T, paths = map_.first.T_map_world, map_.paths
        self.T_map_camera = [T @ paths[n].T_world_camera[frame] for n, frame in self._views.keys]

    def _camera(self, number: int) -> RectifiedCamera:
        return self._map.session(self._views.keys[number][0]).camera

    def outline(self, number: int, depth_m: float) -> Float64:
        """Return line segments (8, 2, 3) around what a keyframe has in view up to a depth."""
        camera, eye = self._camera(number), np.zeros((4, 3))
        u, v = np.array([(0, 1, 1, 0), (0, 0, 1, 1)]) * [[camera.width_px], [camera.height_px]]
        corners = unproject(u - 0.5, v - 0.5, np.full(4, depth_m), camera)
        ends = np.concatenate([eye, corners, corners, np.roll(corners, 1, axis=0)])
        ends = apply(self.T_map_camera[number], ends).reshape(2, 2, 4, 3)
        return np.asarray(np.concatenate(np.swapaxes(ends, 1, 2)))

    def sees(self, number: int, place_m: Float64) -> bool:
        """Return whether a keyframe has a place (3,), map axes, in view, with nothing before it."""
        view = self._views[number]
        xyz = apply(invert(self.T_map_camera[number]), place_m[None])
        u, v, disparity = (float(each[0]) for each in project(xyz, view.camera))
        if not (0 <= u < view.camera.width_px and 0 <= v < view.camera.height_px):
            return False
        coarse = view.keyframe.coarse
        step = -(-view.camera.height_px // len(coarse))
        return bool(disparity > coarse[int(v) // step, int(u) // step] - _BEHIND_PX)

    def look(self, number: int) -> tuple[list[str], UInt8 | None]:
        """Match a keyframe again: what it says; its left image, disparities and reasons.

        The three stand below each other, uint8 (3 H, W, 3); None where the images of the drive are
        not at hand, which a line says.
        """
        session, frame = self._views.keys[number]
        drive = self._map.session(session)
        health, time_s = drive.health[frame], np.ptp(drive.trajectory.timestamps_s[: frame + 1])
        lines = [f"frame {frame} of {drive.info.source}, at {time_s:.1f} s", *health.notes]
        lines += [f"features that agree: {health.inliers}, {health.reprojection_px:.2f} px off"]
        try:
            if session not in self._opened:
                images = {one.session.number: one for one in open_images(self._map)}[session]
                matcher = FrameReconstructor(images.rig, settings_of(drive))
                self._opened[session] = images.source, matcher
            source, matcher = self._opened[session]
            pair, disparity = matcher.match(next(source.frames(frame)))
            self._matched = disparity.only_measured()
        except ReconError as error:
            return [*lines, f"no images: {error}"], None
        ratios = disparity.reason_ratios.items()
        lines.append(", ".join(f"{REASON_LABELS[r]} {100 * ratio:.0f} %" for r, ratio in ratios))
        shown = hatch(colour_disparity(disparity.values), disparity.inferred)
        coloured = shown, colour_reasons(disparity.reason)
        return lines, np.concatenate([pair.colours, *coloured])

    def mark(self, name: str, number: int, ray: Float64, depth_m: float) -> list[str]:
        """Take a click at a control point; return how far the map is off there, by all of them.

        It is in the image of the keyframe that was looked at last, held at a depth before its eye.
        ``ray`` (2, 3), map axes: from where, in which direction. Nothing is returned where it
        passes the image.
        """
        camera, T = self._camera(number), self.T_map_camera[number]
        eye, end = apply(invert(T), np.stack([ray[0], ray.sum(axis=0)]))
        met = eye + (end - eye) * (depth_m - eye[2]) / max((end - eye)[2], 1e-9)
        u, v, _ = (float(each[0]) for each in project(met[None], camera))
        if not (0 <= u <= camera.width_px - 1 and 0 <= v <= camera.height_px - 1):
            return []
        marks = self._marks.setdefault(name, {})
        marks[number] = sighted(T, camera, self._matched, u, v)
        if (found := triangulate([*marks.values()])) is None:
            return [f"{name}: no depth where it was clicked; click it in another keyframe, too"]
        xyz, covariance = found
        R = self._T_survey_map[:3, :3]
        sigma_m = np.sqrt(np.diag(R @ covariance @ R.T) + SURVEYED_M**2)
        off = zip(("East", "North", "Up"), R @ (xyz - self.points[name]), sigma_m, strict=True)
        lines = [f"{axis}: {off_m:+.3f} ± {known_m:.3f} m" for axis, off_m, known_m in off]
        for at, one in marks.items():
            shown = np.stack(project(apply(one.T_camera_map, xyz[None]), one.camera), axis=1)[0]
            off_px = float(np.linalg.norm((shown - one.uvd)[:2]))
            lines.append(f"Frame {self._views.keys[at][1]}: {off_px:.2f} px off")
        return [f"{name}, map minus survey:", *lines]
