"""Stereo reconstruction and mapping: from pairs of pictures to maps.

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
    from recon.errors import ReconError
    from recon.evaluation import (
        MiddleburyRules,
        evaluate_depth,
        evaluate_disparity,
        evaluate_map,
        evaluate_middlebury,
        evaluate_trajectory,
    )
    from recon.formats.calibration import read_calibration
    from recon.formats.image import read_image
    from recon.formats.mesh import read_mesh, write_mesh
    from recon.formats.middlebury import MiddleburyScene, read_middlebury_scene
    from recon.formats.pfm import read_pfm, write_pfm
    from recon.formats.ply import read_ply, write_ply
    from recon.formats.trajectory import read_trajectory
    from recon.matching import Matcher
    from recon.meshing import reconstruct_mesh
    from recon.pipeline.api import match, reconstruct
    from recon.pipeline.audit_run import Audit, run_audit
    from recon.pipeline.config import ReconConfig, load_config
    from recon.pipeline.map_run import MapOptions, run_map
    from recon.pipeline.middlebury_run import MiddleburyOptions, run_middlebury
    from recon.pipeline.occupancy_run import OccupancyRequest, run_occupancy
    from recon.pipeline.pair_run import PairInput, PairOptions, run_pair
    from recon.pipeline.sequence import MappedSequence, map_sequence
    from recon.sources import SourceSettings, StereoSource, open_source
    from recon.sources.synthetic import SyntheticSource
    from recon.structures import (
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

_HOMES = {
    "recon.errors": ("ReconError",),
    "recon.evaluation": (
        "MiddleburyRules",
        "evaluate_depth",
        "evaluate_disparity",
        "evaluate_map",
        "evaluate_middlebury",
        "evaluate_trajectory",
    ),
    "recon.formats.calibration": ("read_calibration",),
    "recon.formats.image": ("read_image",),
    "recon.formats.mesh": ("read_mesh", "write_mesh"),
    "recon.formats.middlebury": ("MiddleburyScene", "read_middlebury_scene"),
    "recon.formats.pfm": ("read_pfm", "write_pfm"),
    "recon.formats.ply": ("read_ply", "write_ply"),
    "recon.formats.trajectory": ("read_trajectory",),
    "recon.matching": ("Matcher",),
    "recon.meshing": ("reconstruct_mesh",),
    "recon.pipeline.api": ("match", "reconstruct"),
    "recon.pipeline.audit_run": ("Audit", "run_audit"),
    "recon.pipeline.config": ("ReconConfig", "load_config"),
    "recon.pipeline.map_run": ("MapOptions", "run_map"),
    "recon.pipeline.middlebury_run": ("MiddleburyOptions", "run_middlebury"),
    "recon.pipeline.occupancy_run": ("OccupancyRequest", "run_occupancy"),
    "recon.pipeline.pair_run": ("PairInput", "PairOptions", "run_pair"),
    "recon.pipeline.sequence": ("MappedSequence", "map_sequence"),
    "recon.sources": ("SourceSettings", "StereoSource", "open_source"),
    "recon.sources.synthetic": ("SyntheticSource",),
    "recon.structures": (
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
    "MapOptions",
    "MappedSequence",
    "Matcher",
    "MiddleburyOptions",
    "MiddleburyRules",
    "MiddleburyScene",
    "OccupancyGrid",
    "OccupancyRequest",
    "OccupancyVoxels",
    "PairInput",
    "PairOptions",
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
