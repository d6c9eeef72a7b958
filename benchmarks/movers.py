"""Moving objects: how much of them is taken out of the fused cloud, and how much else with them.

A rendered street in which cars and people move is mapped once with known poses. Points on
something that moves, and far from what stands, are its points; points on what stands are
judged by how many of them are left, those of posts and lamps apart. The same table for DUFOMap, on
the clouds of the same frames, if it is installed (``pip install dufomap``).

Example: python benchmarks/movers.py --json
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import checkout  # noqa: F401 - what is measured
import numpy as np
import open3d as o3d

from recon.commands.config import ReconConfig, load_config
from recon.core.geometry import se3
from recon.core.values import PointCloud, StereoPair, join_clouds
from recon.core.values.arrays import Bool, Float64
from recon.map.drive.sequence import MappedSequence, map_sequence
from recon.map.fusion import fusion_range_m
from recon.map.sessions.placed import place_map
from recon.sources.synthetic import SyntheticSource
from recon.stereo.frame import FrameReconstructor
from recon.street import props
from recon.street.render import StreetCamera
from recon.street.settings import StreetScene
from recon.street.shapes import Material, Paint, TriangleSoup, cylinder, merge, move

ON_IT_M = 0.15
"""Points within this distance of a surface are on it, give or take its depth error."""
BESIDE_M = 0.4
"""Points farther from a surface than this are not on it."""
THIN = (Material.METAL,)


class Traffic(SyntheticSource):
    """A street with cars and people that move."""

    def __init__(self, settings: StreetScene, pace: float) -> None:
        super().__init__(settings)
        self._step_m = settings.speed_m_per_frame
        self._pace = pace

    def movers(self, index: int) -> list[TriangleSoup]:
        """Return what moves, where it is in a frame, street axes; nothing beside fences."""
        if self.world.settings.fences:
            return []
        rng = np.random.default_rng([self.settings.seed, 5])
        oncoming, leading, crossing = (props.car(rng) for _ in range(3))
        person = cylinder((0.25, 0.2), 1.75, Paint(Material.BARK, (0.5, 0.35, 0.3), 3), 12)
        at, way = self._step_m * index, self._pace * index
        return [
            move(oncoming, placed(60.0 - 1.2 * way, 1.6, np.pi)),
            move(leading, placed(10.0 + 1.3 * self._step_m * way, -1.5, 0.0)),
            move(crossing, placed(34.0, -8.0 + 0.7 * way, np.pi / 2)),
            move(person, placed(14.0 + 0.15 * way, -3.4, 0.0)),
            move(person, placed(22.0 - 0.12 * way, 3.2, 0.0)),
            move(person, placed(at + 8.0, 2.6 - 0.05 * way, 0.0)),
        ]

    def frames(self, start: int = 0) -> Any:
        """Render the pairs from number ``start`` on."""
        return (self.pair(index) for index in range(start, len(self)))

    def pair(self, index: int) -> StereoPair:
        """Render a pair with what moves where it is then."""
        soup = merge([self.world.soup, *self.movers(index)])
        return StreetCamera(replace(self.world, soup=soup)).pair(index)


def placed(x_m: float, y_m: float, turn_rad: float) -> Float64:
    """Return a pose on the road, street axes."""
    turn = se3.exp_so3(np.array([0.0, 0.0, turn_rad]))
    return se3.make_transform(turn, np.array([x_m, y_m, 0.02]))


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    config = load_config()
    source = Traffic(scene_of(options), options.pace)
    began = time.perf_counter()
    mapped = map_sequence(source, config, known_poses=source.trajectory)
    before, after = (cloud_of(mapped, config, remove=on) for on in (False, True))
    truth = Truth(source, fusion_range_m(mapped.camera, config.fusion))
    result: dict[str, Any] = {
        "frames": len(source),
        "seconds": round(time.perf_counter() - began, 1),
        "recon": truth.score(before, after),
    }
    peer = dufomap(source, config, before)
    if peer is not None:
        result["dufomap"] = truth.score(before, peer)
    print(json.dumps(result, indent=2))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="JSON, which is printed anyway")
    parser.add_argument("--seed", type=int, default=4, help="another seed is another street")
    parser.add_argument("--pace", type=float, default=1.0, help="speed of what moves; 1 = as it is")
    parser.add_argument(
        "--fences", action="store_true", help="nothing moves; much can be looked through"
    )
    parser.add_argument("--frames", type=int, default=40, help="length of the drive")
    parser.add_argument("--width", type=int, default=480, help="width of the pictures")
    return parser.parse_args(arguments)


def scene_of(options: argparse.Namespace) -> StreetScene:
    return StreetScene(
        seed=options.seed,
        frames=options.frames,
        path="straight",
        fences=options.fences,
        speed_m_per_frame=0.7,
        width_px=options.width,
        height_px=options.width * 3 // 8,
        focal_px=options.width * 0.5625,
        smooth_edges=False,
    )


def cloud_of(mapped: MappedSequence, config: ReconConfig, *, remove: bool) -> PointCloud:
    """Return the fused cloud with or without what moved, street world."""
    fusion = config.fusion.model_copy(update={"remove_moving": remove})
    settings = config.model_copy(update={"fusion": fusion})
    cloud = join_clouds(tile.cloud for tile in place_map(mapped.map, settings).tiles)
    T = se3.invert(mapped.T_map_world)
    return replace(cloud, xyz=se3.apply(T, cloud.xyz), normals=None, frame="world")


class Truth:
    """What stands and what moves, as surfaces.

    Args:
        source: The street.
        reach_m: Farthest points that are fused.
    """

    def __init__(self, source: Traffic, reach_m: float) -> None:
        T = source.world.T_world_street
        soup = source.world.soup
        thin = np.isin(soup.material, THIN)
        moving = [source.movers(index) for index in range(len(source))]
        self.standing = Surface([soup.vertices], T)
        self.thin = Surface([soup.vertices[thin]], T)
        soups = [soup.vertices for soups in moving for soup in soups]
        self.moving = Surface(soups, T) if soups else None
        self.reach_m = reach_m

    def score(self, before: PointCloud, after: PointCloud) -> dict[str, Any]:
        """Return the fractions of points that are gone."""
        left = distances(after.xyz, before.xyz) < 0.01
        from_standing = self.standing.distance(before.xyz)
        from_moving = np.full(len(before), np.inf)
        if self.moving is not None:
            from_moving = self.moving.distance(before.xyz)
        # What is near both may be of either.
        moves = (from_standing > BESIDE_M) & (from_moving <= ON_IT_M)
        stands = (from_standing <= ON_IT_M) & (from_moving > BESIDE_M)
        found = {
            "moving_points": int(moves.sum()),
            "moving_gone": ratio(~left[moves]),
            "static_points": int(stands.sum()),
            "static_lost": ratio(~left[stands]),
        }
        thin = stands & (self.thin.distance(before.xyz) <= ON_IT_M)
        return found | {"thin_points": int(thin.sum()), "thin_lost": ratio(~left[thin])}


class Surface:
    """Triangles that distances are measured to."""

    def __init__(self, triangles: Sequence[Float64], T_world_street: Float64) -> None:
        corners = np.concatenate(triangles).reshape(-1, 3)
        xyz = se3.apply(T_world_street, corners.astype(np.float64)).astype(np.float32)
        self._scene = o3d.t.geometry.RaycastingScene()
        faces = np.arange(len(xyz), dtype=np.uint32).reshape(-1, 3)
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(xyz), o3d.core.Tensor.from_numpy(faces)
        )

    def distance(self, xyz: Any) -> Float64:
        """Return float64 (N,), distance of points."""
        points = o3d.core.Tensor.from_numpy(np.ascontiguousarray(xyz, np.float32))
        return np.asarray(self._scene.compute_distance(points).numpy(), np.float64)


def distances(targets: Any, points: Any) -> Float64:
    """Return float64 (N,), distance of points from the nearest target."""
    one, other = (o3d.geometry.PointCloud() for _ in range(2))
    one.points = o3d.utility.Vector3dVector(np.array(points, np.float64))
    other.points = o3d.utility.Vector3dVector(np.array(targets, np.float64))
    return np.asarray(one.compute_point_cloud_distance(other))


def ratio(which: Bool) -> float | None:
    return round(float(which.mean()), 4) if len(which) else None


def dufomap(source: Traffic, config: ReconConfig, cloud: PointCloud) -> PointCloud | None:
    """Return what DUFOMap leaves of a cloud, from the same frames; None = not installed."""
    try:
        from dufomap import dufomap as Dufomap  # noqa: N812, PLC0415 - its name; optional
    except ImportError:
        return None
    reconstruct = FrameReconstructor(source.calibration, config)
    peer = Dufomap(0.1, 0.2, 2)  # resolution, and its defaults for noise and localisation
    poses = source.trajectory.T_world_camera
    for number, pair in enumerate(source.frames()):
        xyz = reconstruct.reconstruct(pair).cloud.xyz.astype(np.float32)
        peer.run(xyz, poses[number], cloud_transform=True)
    peer.oncePropagateCluster(if_propagate=True, if_cluster=False)
    labels = peer.segment(cloud.xyz.astype(np.float32), np.eye(4), cloud_transform=False)
    return cloud.select(np.asarray(labels) == 0)


if __name__ == "__main__":
    main()
