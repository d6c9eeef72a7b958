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
from recon.stereo.kernels import path_costs
from recon.street.kernels import surface

_POINT: Final = np.zeros((1, 3))
_ONE: Final = np.ones(1)
_VOXEL: Final = voxels.VoxelPoints(_POINT, np.ones(1, np.float32), np.zeros((1, 0), np.float32))
_CELLS: Final = np.array([[-1, 0, 0], [0, 0, 0], [1, 0, 0]], np.int32)
_SUMS: Final = np.tile(np.array([1, 0, 0, 0, 1], np.float32), (3, 1))
_POSES: Final = bundle.NormalEquations(
    np.zeros((2, 6, 6)), np.zeros((2, 6)), np.zeros((1, 3, 3)), _POINT, np.zeros((2, 1, 6, 3))
)
_GREY: Final = np.zeros((4, 64), np.uint8)
_PLANES: Final = np.empty((4, path_costs.PLANES, 64), np.uint8)

SAMPLES: Final[Mapping[str, Callable[[], object]]] = MappingProxyType(
    {
        "core": lambda: voxels.add_points(voxels.make_sums(1, 0), _VOXEL, 1.0, 0),
        "io": lambda: octree.find_leaves(np.zeros(1, np.uint8), octree.begin_walk(16)),
        "map": lambda: facets.crossed_cells(_CELLS, voxels.pack_keys(_CELLS), _SUMS),
        "odometry": lambda: bundle.solve_step(_POSES, 1.0),
        "stereo": lambda: path_costs.write_planes(_GREY, 0, 0, 4, _PLANES),
        "street": lambda: surface.fractal_noise(_POINT, _POINT, _ONE, _ONE, 1, 0.5, 0),
    }
)
