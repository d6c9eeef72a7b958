"""Immutable data types: validated on construction, numpy only; no file access, no drawing."""

from recon.core.values.camera import (
    LARGEST_CENTRE_OFFSET,
    CameraIntrinsics,
    LensModel,
    RectifiedCamera,
    Rig,
    StereoCalibration,
    check_size,
    check_unsized,
    other_size,
)
from recon.core.values.cloud import Frame, PointCloud, join_clouds
from recon.core.values.disparity import Disparity, Reason
from recon.core.values.grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    OccupancyVoxels,
    join_voxels,
)
from recon.core.values.image import RectifiedPair, StereoPair
from recon.core.values.mesh import TriangleMesh
from recon.core.values.metrics import (
    DepthMetrics,
    DisparityMetrics,
    GridMetrics,
    LengthErrors,
    MapMetrics,
    OccupancyMetrics,
    TrajectoryMetrics,
    VoxelMetrics,
)
from recon.core.values.rays import RayCloud, RayGrain
from recon.core.values.trajectory import Trajectory
from recon.core.values.truth import DisparityTruth, OccupancyTruth, SequenceTruth

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
    "Rig",
    "SequenceTruth",
    "StereoCalibration",
    "StereoPair",
    "Trajectory",
    "TrajectoryMetrics",
    "TriangleMesh",
    "VoxelMetrics",
    "check_size",
    "check_unsized",
    "join_clouds",
    "join_voxels",
    "other_size",
]
