"""Stereo reconstruction and mapping: from image pairs to maps.

The whole flow in two lines::

    import recon

    run = recon.run_map(recon.open_source("kitti/sequences/06"), recon.load_config())

Every name of `__all__` is imported when it is first used, so ``import recon`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from recon.commands.api import match, reconstruct
    from recon.commands.audit import run_audit
    from recon.commands.config import ReconConfig, load_config
    from recon.commands.evaluate_middlebury import run_middlebury
    from recon.commands.export import run_export
    from recon.commands.live import run_live
    from recon.commands.localize import run_localize
    from recon.commands.map import run_map
    from recon.commands.map_options import MapOptions
    from recon.commands.occupancy import run_occupancy
    from recon.commands.pair import run_disparity, run_pair
    from recon.core.errors import ReconError
    from recon.core.values import (
        CameraIntrinsics,
        Disparity,
        DisparityMetrics,
        DisparityTruth,
        OccupancyGrid,
        OccupancyVoxels,
        PointCloud,
        Reason,
        RectifiedCamera,
        RectifiedPair,
        StereoCalibration,
        StereoPair,
        Trajectory,
        TriangleMesh,
    )
    from recon.evaluation.disparity import evaluate_depth, evaluate_disparity
    from recon.evaluation.map import evaluate_map
    from recon.evaluation.middlebury.rules import MiddleburyRules, evaluate_middlebury
    from recon.evaluation.trajectory import evaluate_trajectory
    from recon.export.mesh import reconstruct_mesh
    from recon.io.cameras.calibration import read_calibration
    from recon.io.images.image import read_image
    from recon.io.images.pfm import read_pfm, write_pfm
    from recon.io.middlebury.scene import MiddleburyScene, read_middlebury_scene
    from recon.io.models.mesh import read_mesh, write_mesh
    from recon.io.models.ply import read_ply, write_ply
    from recon.io.trajectory import read_trajectory
    from recon.map.drive.sequence import MappedSequence, map_sequence
    from recon.map.store.map import Map
    from recon.rig.audit.audit import Audit
    from recon.sources.pair_input import PairInput
    from recon.sources.protocol import StereoSource
    from recon.sources.registry import open_source
    from recon.sources.settings import SourceSettings
    from recon.sources.synthetic import SyntheticSource
    from recon.stereo.match.protocol import Matcher

_HOMES = {
    "recon.core.errors": ("ReconError",),
    "recon.evaluation.disparity": ("evaluate_depth", "evaluate_disparity"),
    "recon.evaluation.map": ("evaluate_map",),
    "recon.evaluation.middlebury.rules": ("MiddleburyRules", "evaluate_middlebury"),
    "recon.evaluation.trajectory": ("evaluate_trajectory",),
    "recon.io.cameras.calibration": ("read_calibration",),
    "recon.io.images.image": ("read_image",),
    "recon.io.models.mesh": ("read_mesh", "write_mesh"),
    "recon.io.middlebury.scene": ("MiddleburyScene", "read_middlebury_scene"),
    "recon.io.images.pfm": ("read_pfm", "write_pfm"),
    "recon.io.models.ply": ("read_ply", "write_ply"),
    "recon.io.trajectory": ("read_trajectory",),
    "recon.stereo.match.protocol": ("Matcher",),
    "recon.export.mesh": ("reconstruct_mesh",),
    "recon.commands.api": ("match", "reconstruct"),
    "recon.rig.audit.audit": ("Audit",),
    "recon.commands.audit": ("run_audit",),
    "recon.commands.config": ("ReconConfig", "load_config"),
    "recon.commands.live": ("run_live",),
    "recon.commands.localize": ("run_localize",),
    "recon.commands.map": ("run_map",),
    "recon.commands.map_options": ("MapOptions",),
    "recon.commands.evaluate_middlebury": ("run_middlebury",),
    "recon.commands.export": ("run_export",),
    "recon.commands.occupancy": ("run_occupancy",),
    "recon.commands.pair": ("run_disparity", "run_pair"),
    "recon.sources.pair_input": ("PairInput",),
    "recon.map.store.map": ("Map",),
    "recon.map.drive.sequence": ("MappedSequence", "map_sequence"),
    "recon.sources.protocol": ("StereoSource",),
    "recon.sources.registry": ("open_source",),
    "recon.sources.settings": ("SourceSettings",),
    "recon.sources.synthetic": ("SyntheticSource",),
    "recon.core.values": (
        "CameraIntrinsics",
        "Disparity",
        "DisparityMetrics",
        "DisparityTruth",
        "OccupancyGrid",
        "OccupancyVoxels",
        "PointCloud",
        "Reason",
        "RectifiedCamera",
        "RectifiedPair",
        "StereoCalibration",
        "StereoPair",
        "Trajectory",
        "TriangleMesh",
    ),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Audit",
    "CameraIntrinsics",
    "Disparity",
    "DisparityMetrics",
    "DisparityTruth",
    "Map",
    "MapOptions",
    "MappedSequence",
    "Matcher",
    "MiddleburyRules",
    "MiddleburyScene",
    "OccupancyGrid",
    "OccupancyVoxels",
    "PairInput",
    "PointCloud",
    "Reason",
    "ReconConfig",
    "ReconError",
    "RectifiedCamera",
    "RectifiedPair",
    "SourceSettings",
    "StereoCalibration",
    "StereoPair",
    "StereoSource",
    "SyntheticSource",
    "Trajectory",
    "TriangleMesh",
    "evaluate_depth",
    "evaluate_disparity",
    "evaluate_map",
    "evaluate_middlebury",
    "evaluate_trajectory",
    "load_config",
    "map_sequence",
    "match",
    "open_source",
    "read_calibration",
    "read_image",
    "read_mesh",
    "read_middlebury_scene",
    "read_pfm",
    "read_ply",
    "read_trajectory",
    "reconstruct",
    "reconstruct_mesh",
    "run_audit",
    "run_disparity",
    "run_export",
    "run_live",
    "run_localize",
    "run_map",
    "run_middlebury",
    "run_occupancy",
    "run_pair",
    "write_mesh",
    "write_pfm",
    "write_ply",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its home (PEP 562)."""
    if name not in _HOME_OF:
        raise AttributeError(f"module 'recon' has no attribute {name!r}")
    return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
