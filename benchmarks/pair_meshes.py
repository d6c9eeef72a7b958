"""How true the surface of a pair is: that of its pixels, and that of MeshLab's Poisson.

Of every pixel with a known disparity, the ray is followed to the surface. ``covered`` is the share
of the rays that meet it, ``within 1 px`` the fraction of all that meet it where it is, as a
disparity; mean and 95 % are of those that meet it. ``on points`` is the fraction of the points
that lie on it. Triangles within which the depth changes much are curtains between surfaces, or
surfaces that are seen along themselves: ``over 10 %`` and ``over 20 %`` are their fractions of the
area.

Of a drive, the first pair is taken; without a truth, there are fewer figures.

Example: python benchmarks/pair_meshes.py scenes/Motorcycle drives/kitti --json
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import checkout  # noqa: F401 - what is measured
import numpy as np
import open3d as o3d

from recon.commands.config import PAIR_DEFAULTS, load_config
from recon.core.open3d_raycasting import RayScene
from recon.core.values import RectifiedCamera, StereoCalibration, TriangleMesh
from recon.core.values.arrays import Float64
from recon.core.values.camera import unproject
from recon.core.values.image import Recorded
from recon.export.mesh.grid import mesh_grid
from recon.export.mesh.poisson import reconstruct_mesh
from recon.export.pair import mesh_coverage
from recon.io.images.disparity import read_disparity
from recon.sources.one_pair import read_pair_input
from recon.sources.registry import open_source
from recon.stereo.frame import FrameReconstructor


def measure(mesh: TriangleMesh, camera: RectifiedCamera, truth_px: Float64) -> dict[str, float]:
    """Compare a surface in camera axes with true disparities (H, W); NaN or 0 = unknown."""
    row, column = np.nonzero(np.isfinite(truth_px) & (truth_px > 0))
    rays = unproject(column, row, np.ones(len(row)), camera)
    face = RayScene(mesh.vertices[mesh.faces]).first_hit(np.zeros(3), rays)
    a, b, c = mesh.vertices[mesh.faces[face[face >= 0]]].astype(np.float64).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    depth_m = np.einsum("ij,ij->i", normal, a) / np.einsum("ij,ij->i", normal, rays[face >= 0])
    found = camera.focal_px * camera.baseline_m / depth_m - camera.doffs_px
    off = np.abs(found - truth_px[row, column][face >= 0])
    return {
        "covered": len(off) / len(face),
        "within 1 px": float((off < 1).sum() / len(face)),
        "mean": float(off.mean()),
        "95 %": float(np.quantile(off, 0.95)),
    }


def changes(mesh: TriangleMesh) -> dict[str, float]:
    """Fractions of the area of a mesh whose triangles change depth by more than 10 and 20 %."""
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    depth_m = np.stack([a[:, 2], b[:, 2], c[:, 2]])
    change = depth_m.max(axis=0) / depth_m.min(axis=0) - 1
    return {f"over {n} %": float(100 * area[change > n / 100].sum() / area.sum()) for n in (10, 20)}


def not_manifold(mesh: TriangleMesh) -> tuple[int, int]:
    """How many edges of a mesh more than two triangles share, and vertices that join several."""
    surface = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices.astype(np.float64)),
        o3d.utility.Vector3iVector(np.array(mesh.faces)),
    )
    edges = surface.get_non_manifold_edges(allow_boundary_edges=True)
    return len(edges), len(surface.get_non_manifold_vertices())


def compare(scene: Path, only: str | None = None) -> dict[str, dict[str, Any]]:
    """Mesh a scene of Middlebury, or the first pair of a drive, in both ways."""
    config = load_config(defaults=PAIR_DEFAULTS)
    pair, rig, truth_px = read_scene(scene)
    frame = FrameReconstructor(rig, config).reconstruct(pair)
    camera = frame.pair.camera
    found = {}
    ways: dict[str, Callable[[], TriangleMesh]] = {
        "grid": lambda: mesh_grid(frame.cloud, camera, config.mesh),
        "poisson": lambda: reconstruct_mesh(frame.cloud, config.mesh, (0.0, 0.0, 0.0)),
    }
    for name, make in ways.items():
        if only not in (None, name):
            continue
        start = time.perf_counter()
        mesh = make()
        seconds = time.perf_counter() - start
        figures = {} if truth_px is None else measure(mesh, camera, truth_px)
        found[name] = {
            **figures,
            "on points": mesh_coverage(mesh, frame.cloud),
            **changes(mesh),
            "faces": len(mesh.faces),
            "not manifold": sum(not_manifold(mesh)),
            "seconds": seconds,
        }
    return found


def read_scene(folder: Path) -> tuple[Recorded, RectifiedCamera | StereoCalibration, Any]:
    """The pair of a folder, its cameras, and the true disparity (H, W) if that is known."""
    if (folder / "im0.png").is_file():
        given = read_pair_input(*(folder / name for name in ("im0.png", "im1.png", "calib.txt")))
        truth_px = read_disparity(folder / "disp0GT.pfm").astype(np.float64)
        return given.pair, given.calibration, truth_px
    source = open_source(folder)
    return next(iter(source.frames())), source.calibration, None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--only", choices=("grid", "poisson"), help="only this surface")
    given = parser.parse_args()
    found = {scene.name: compare(scene, given.only) for scene in given.scenes}
    if given.json:
        print(json.dumps(found))
        return
    for scene, ways in found.items():
        for way, figures in ways.items():
            line = "  ".join(f"{name} {value:.3g}" for name, value in figures.items())
            print(f"{scene:12} {way:8} {line}")


if __name__ == "__main__":
    main()
