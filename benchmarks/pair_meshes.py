"""How true the surface of a pair is: that of its pixels, and that of MeshLab's Poisson.

Of every pixel with a known disparity, the ray is followed to the surface. ``covered`` is the share
of the rays that meet it, ``within 1 px`` the share of all that meet it where it is, as a disparity;
mean and 95 % are of those that meet it.

Example: python benchmarks/pair_meshes.py scenes/Motorcycle scenes/Piano --json
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import checkout  # noqa: F401 - what is measured
import numpy as np
import open3d as o3d

from recon.commands.config import PAIR_DEFAULTS, load_config
from recon.core.open3d_raycasting import RayScene
from recon.core.values import RectifiedCamera, TriangleMesh
from recon.core.values.arrays import Float64
from recon.core.values.camera import unproject
from recon.export.mesh.grid import mesh_grid
from recon.export.mesh.poisson import reconstruct_mesh
from recon.io.images.disparity import read_disparity
from recon.sources.one_pair import read_pair_input
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
        "faces": len(mesh.faces),
        "not manifold": sum(not_manifold(mesh)),
    }


def not_manifold(mesh: TriangleMesh) -> tuple[int, int]:
    """How many edges of a mesh more than two triangles share, and vertices that join several."""
    surface = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices.astype(np.float64)),
        o3d.utility.Vector3iVector(np.array(mesh.faces)),
    )
    edges = surface.get_non_manifold_edges(allow_boundary_edges=True)
    return len(edges), len(surface.get_non_manifold_vertices())


def compare(scene: Path) -> dict[str, dict[str, Any]]:
    """Mesh a scene of Middlebury in both ways."""
    config = load_config(defaults=PAIR_DEFAULTS)
    given = read_pair_input(*(scene / name for name in ("im0.png", "im1.png", "calib.txt")))
    frame = FrameReconstructor(given.calibration, config).reconstruct(given.pair)
    truth_px, camera = read_disparity(scene / "disp0GT.pfm").astype(np.float64), frame.pair.camera
    start = time.perf_counter()
    of_pixels = mesh_grid(frame.cloud, camera, config.mesh)
    middle = time.perf_counter()
    of_meshlab = reconstruct_mesh(frame.cloud, config.mesh, (0.0, 0.0, 0.0))
    end = time.perf_counter()
    return {
        "grid": {"seconds": middle - start, **measure(of_pixels, camera, truth_px)},
        "poisson": {"seconds": end - middle, **measure(of_meshlab, camera, truth_px)},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    found = {scene.name: compare(scene) for scene in given.scenes}
    if given.json:
        print(json.dumps(found))
        return
    for scene, ways in found.items():
        for way, figures in ways.items():
            line = "  ".join(f"{name} {value:.3g}" for name, value in figures.items())
            print(f"{scene:12} {way:8} {line}")


if __name__ == "__main__":
    main()
