"""Screened Poisson reconstruction by pymeshlab, in a child process.

MeshLab's Poisson may abort the process, exhaust its memory, print, or leave it in a deleted
working directory. A child process for each surface shields the caller from this; it costs about
half a second. Importing the folder ``mesh`` would load Open3D into every child.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import MeshingError
from recon.core.text import counted
from recon.core.values.arrays import Float32, Int32

_POINTS, _SURFACE = "points.npz", "surface.npz"


def screened_poisson(
    xyz: NDArray[Any], normals: NDArray[Any], depth: int, scale: float, point_weight: float
) -> tuple[Float32, Int32, Float32]:
    """Return the closed surface through points (N, 3) with outward unit normals, all finite.

    Args:
        xyz: Metres.
        normals: Of the points.
        depth: Depth of the octree: its edge, ``scale`` times the longest side of the cloud, has
            2^depth cells.
        scale: See ``depth``.
        point_weight: Weight of interpolating the points relative to fitting the normals.

    Returns:
        Vertices (V, 3), faces (F, 3), and the point density around each vertex, in octree levels
        (one level more = four times as dense).
    """
    # A single NaN can make MeshLab return nothing, or a surface that is wrong everywhere.
    if not (np.isfinite(xyz).all() and np.isfinite(normals).all()):
        raise MeshingError("a point or normal of the cloud is not finite")
    options = {
        "depth": depth,
        "scale": scale,
        "samplespernode": 1.5,  # points that an octree cell should hold: more for noisy ones
        "pointweight": point_weight,
        # More threads make the result non-deterministic, and busy-wait: on a loaded machine, two
        # took twenty times as long as one.
        "threads": 1,
        "preclean": True,
    }
    with tempfile.TemporaryDirectory(prefix="recon-poisson-") as folder:
        np.savez(Path(folder) / _POINTS, xyz=xyz, normals=normals)
        _run_child(folder, options)
        with np.load(Path(folder) / _SURFACE) as surface:
            vertices, faces, density = (surface[x] for x in ("vertices", "faces", "density"))
    if len(faces) == 0:
        got, hint = counted(len(xyz), "point"), "check that the normals point out of the surface"
        raise MeshingError("Poisson reconstruction found no surface", got=got, hint=hint)
    return vertices, faces, density


def _run_child(folder: str, options: dict[str, Any]) -> None:
    """Run this module as a program on the files in a folder."""
    # The child must be able to import this package however the parent found it.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    child = subprocess.run(
        [sys.executable, "-m", __name__, folder, json.dumps(options)],
        capture_output=True,
        check=False,
        cwd=folder,
        env=environment,
        text=True,
        errors="replace",
    )
    if child.returncode:
        lines = child.stderr.strip().splitlines()
        got = lines[-1] if lines else f"exit code {child.returncode}"
        hint = "try a smaller depth" if child.returncode < 0 else None
        raise MeshingError("Poisson reconstruction failed in MeshLab", got=got, hint=hint)


def _reconstruct(folder: Path, options: dict[str, Any]) -> None:
    """Work of the child process: points.npz in, surface.npz out."""
    import pymeshlab  # noqa: PLC0415 - only the child needs this slow import

    with np.load(folder / _POINTS) as points:
        cloud = pymeshlab.Mesh(
            vertex_matrix=points["xyz"].astype(np.float64),
            v_normals_matrix=points["normals"].astype(np.float64),
        )
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(cloud)
    meshes.generate_surface_reconstruction_screened_poisson(**options)
    surface = meshes.current_mesh()
    np.savez(
        folder / _SURFACE,
        vertices=surface.vertex_matrix().astype(np.float32),
        faces=surface.face_matrix().astype(np.int32).reshape(-1, 3),
        density=surface.vertex_scalar_array().astype(np.float32),
    )


if __name__ == "__main__":
    _reconstruct(Path(sys.argv[1]), json.loads(sys.argv[2]))
