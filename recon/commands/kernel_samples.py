"""A small call of one kernel of each room, which `recon doctor` makes in a process of its own.

`recon.commands.doctor` runs this file by its name. It knows kernels alone, and so starts fast.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from recon.core.kernels import voxels
from recon.io.kernels import octree
from recon.map.kernels import facets
from recon.odometry.kernels import bundle
from recon.stereo.kernels import census
from recon.street.kernels import noise


def _sum_points() -> None:
    """Add a point to no voxels."""
    point = voxels.VoxelPoints(
        np.zeros((1, 3)), np.ones(1, np.float32), np.zeros((1, 0), np.float32)
    )
    voxels.add_points(voxels.make_sums(1, 0), point, 1.0, 0)


def _walk_tree() -> None:
    """Walk over a tree that is one leaf."""
    octree.find_leaves(np.zeros(1, np.uint8), octree.begin_walk(16))


def _fit_plane() -> None:
    """Find the normal of three points in a row of cells."""
    cells = np.array([[-1, 0, 0], [0, 0, 0], [1, 0, 0]], np.int32)
    sums = np.tile(np.array([1, 0, 0, 0], np.float32), (3, 1))
    facets.crossed_cells(cells, voxels.pack_keys(cells), sums)


def _solve_system() -> None:
    """Solve for two poses and a point that nothing was seen of."""
    H_pose, g_pose = np.zeros((2, 6, 6)), np.zeros((2, 6))
    H_point, g_point, H_cross = np.zeros((1, 3, 3)), np.zeros((1, 3)), np.zeros((2, 1, 6, 3))
    bundle.solve_step(bundle.NormalEquations(H_pose, g_pose, H_point, g_point, H_cross), 1.0)


def _describe_pixels() -> None:
    """Describe the pixels of a grey image, many at a time."""
    descriptor, grey = census.Descriptor(127, 2, 2), np.zeros((4, 64), np.uint8)
    planes = np.empty((4, descriptor.planes, 64), np.uint8)
    census.write_planes(grey, descriptor, 0, 0, 4, planes)


def _colour_surface() -> None:
    """Draw the texture of the rendered street in a point."""
    noise.fractal_noise(np.zeros((1, 3)), np.zeros((1, 3)), np.ones(1), np.ones(1), 1, 0.5, 0)


SAMPLES: Final[Mapping[str, Callable[[], None]]] = MappingProxyType(
    {
        "core": _sum_points,
        "io": _walk_tree,
        "map": _fit_plane,
        "odometry": _solve_system,
        "stereo": _describe_pixels,
        "street": _colour_surface,
    }
)
