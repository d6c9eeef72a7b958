"""How long the surface of a drive takes, and how true it is: of its voxels, and MeshLab's Poisson.

The drive is mapped once, then its products are made with each surface, as by `recon export`.
``mesh / mapping`` is the time of the surface over that of mapping, first frame to last. Points
spread evenly over the surface are compared with the reference, within its reach, as by
`recon evaluate map --align-to POSES`. ``border`` is the length of edges of a single triangle.

Example: python benchmarks/drive_meshes.py DRIVE lidar_map.ply poses.txt --json
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import numpy as np
import open3d as o3d
from pair_meshes import not_manifold

from recon.commands.config import load_config
from recon.commands.export import run_export
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.values import PointCloud, TriangleMesh
from recon.core.values.arrays import Float32
from recon.evaluation.map import evaluate_map, place_cloud, read_mapped_cloud, within_reach
from recon.io.models.mesh import read_mesh
from recon.io.models.ply import read_ply
from recon.sources.registry import open_source

THRESHOLD_M: Final = 0.2
PER_M2: Final = 100  # points of the surface: as many as voxels of 0.1 m


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("reference", type=Path, help="cloud in the axes of the poses, PLY")
    parser.add_argument("poses", type=Path, help="true poses, to which the path is aligned")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = measure(given.drive, given.reference, given.poses, Path(folder))
    if given.json:
        print(json.dumps(found))
        return
    for way, figures in found.items():
        print(f"{way:8}", "  ".join(f"{name} {value:.3g}" for name, value in figures.items()))


def measure(drive: Path, reference: Path, poses: Path, folder: Path) -> dict[str, dict[str, Any]]:
    """Map a drive, and compare its surfaces."""
    run = folder / "run"
    options = MapOptions(out=run, mesh=False, audit=False)
    summary = run_map(open_source(drive), load_config(None), options).summary.to_json()
    mapping_s = summary["frames"] / summary["fps"]
    true, found = replace(read_ply(reference), frame="camera"), {}
    for way in ("grid", "poisson"):
        out = folder / way
        config = load_config(run / "config.yaml", [f"mesh.surface={way}"])
        # The surface needs points and voxels of tiles, which the others make first.
        run_export(run, config, products=("cloud", "octomap", "mesh"), out=out)
        seconds = json.loads((out / "run.json").read_text())["timings"]["mesh"]
        mesh = read_mesh(out / "mesh" / "mesh.ply")
        found[way] = {
            "seconds": seconds,
            "mesh / mapping": seconds / mapping_s,
            **against(mesh, run, true, poses),
            "faces": len(mesh.faces),
            "border": border_m(mesh),
            "edges not manifold": not_manifold(mesh)[0],
        }
    return found


def against(mesh: TriangleMesh, run: Path, true: PointCloud, poses: Path) -> dict[str, float]:
    """Compare points spread over a surface in map axes with a cloud."""
    cloud = PointCloud(spread(mesh), frame="map")
    placed, _ = place_cloud(replace(read_mapped_cloud(run), cloud=cloud), "camera", poses)
    if placed.path is None:
        raise LookupError(f"{run} has no path")
    seen = placed.cloud.select(within_reach(placed.cloud, true, placed.path))
    one = evaluate_map(seen, true, THRESHOLD_M)
    return {"precision": one.precision, "recall": one.recall, "F": one.f_score}


def spread(mesh: TriangleMesh) -> Float32:
    """Points (N, 3), evenly over a surface."""
    surface = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices.astype(np.float64)),
        o3d.utility.Vector3iVector(np.array(mesh.faces)),
    )
    o3d.utility.random.seed(0)
    number = int(PER_M2 * surface.get_surface_area())
    return np.asarray(surface.sample_points_uniformly(number).points).astype(np.float32)


def border_m(mesh: TriangleMesh) -> float:
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    begin, end = mesh.vertices[edges[count == 1]].transpose(1, 0, 2)
    return float(np.linalg.norm(end - begin, axis=1).sum())


if __name__ == "__main__":
    main()
