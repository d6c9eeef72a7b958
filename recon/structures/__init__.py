"""Immutable data types: validated on construction, numpy only; no file access, no drawing."""

from recon.structures.camera import (
    LARGEST_CENTRE_OFFSET,
    CameraIntrinsics,
    LensModel,
    RectifiedCamera,
    StereoCalibration,
    check_size,
    check_unsized,
    other_size,
)
from recon.structures.cloud import Frame, PointCloud
from recon.structures.disparity import Disparity, Reason
from recon.structures.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, OccupancyVoxels
from recon.structures.image import RectifiedPair, StereoPair
from recon.structures.mesh import TriangleMesh
from recon.structures.metrics import (
    DepthMetrics,
    DisparityMetrics,
    GridMetrics,
    LengthErrors,
    MapMetrics,
    OccupancyMetrics,
    TrajectoryMetrics,
    VoxelMetrics,
)
from recon.structures.rays import RayCloud, RayGrain
from recon.structures.trajectory import Trajectory
from recon.structures.truth import DisparityTruth, OccupancyTruth, SequenceTruth

__all__ = [
    "FREE",
    "LARGEST_CENTRE_OFFSET",
    "OCCUPIED",
    "UNKNOWN",
    "CameraIntrinsics",
    "DepthMetrics",
    "Disparity",
    "DisparityMetrics",
    "DisparityTruth",
    "Frame",
    "GridMetrics",
    "LengthErrors",
    "LensModel",
    "MapMetrics",
    "OccupancyGrid",
    "OccupancyMetrics",
    "OccupancyTruth",
    "OccupancyVoxels",
    "PointCloud",
    "RayCloud",
    "RayGrain",
    "Reason",
    "RectifiedCamera",
    "RectifiedPair",
    "SequenceTruth",
    "StereoCalibration",
    "StereoPair",
    "Trajectory",
    "TrajectoryMetrics",
    "TriangleMesh",
    "VoxelMetrics",
    "check_size",
    "check_unsized",
    "other_size",
]
