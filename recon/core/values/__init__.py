"""Immutable data types: validated on construction, numpy only; no file access, no drawing.

What a notebook shows of them is made by layers above, on demand (`recon.core.lazy`).
"""

from recon.core.values.camera import LARGEST_CENTRE_OFFSET as LARGEST_CENTRE_OFFSET
from recon.core.values.camera import LENS_COEFFICIENTS as LENS_COEFFICIENTS
from recon.core.values.camera import PINHOLE_COUNTS as PINHOLE_COUNTS
from recon.core.values.camera import CameraIntrinsics as CameraIntrinsics
from recon.core.values.camera import LensModel as LensModel
from recon.core.values.camera import RectifiedCamera as RectifiedCamera
from recon.core.values.camera import Rig as Rig
from recon.core.values.camera import StereoCalibration as StereoCalibration
from recon.core.values.camera import check_rotation as check_rotation
from recon.core.values.camera import check_side_by_side as check_side_by_side
from recon.core.values.camera import check_size as check_size
from recon.core.values.camera import check_unsized as check_unsized
from recon.core.values.camera import other_size as other_size
from recon.core.values.cloud import ATTRIBUTES as ATTRIBUTES
from recon.core.values.cloud import Attribute as Attribute
from recon.core.values.cloud import Frame as Frame
from recon.core.values.cloud import PointCloud as PointCloud
from recon.core.values.cloud import RayCloud as RayCloud
from recon.core.values.cloud import RayGrain as RayGrain
from recon.core.values.cloud import Texture as Texture
from recon.core.values.cloud import TriangleMesh as TriangleMesh
from recon.core.values.cloud import join_clouds as join_clouds
from recon.core.values.grid import FREE as FREE
from recon.core.values.grid import OCCUPIED as OCCUPIED
from recon.core.values.grid import UNKNOWN as UNKNOWN
from recon.core.values.grid import OccupancyGrid as OccupancyGrid
from recon.core.values.grid import OccupancyVoxels as OccupancyVoxels
from recon.core.values.grid import join_voxels as join_voxels
from recon.core.values.image import Disparity as Disparity
from recon.core.values.image import Reason as Reason
from recon.core.values.image import Recorded as Recorded
from recon.core.values.image import Rectified as Rectified
from recon.core.values.image import RectifiedImage as RectifiedImage
from recon.core.values.image import RectifiedPair as RectifiedPair
from recon.core.values.image import StereoPair as StereoPair
from recon.core.values.trajectory import ImuRecord as ImuRecord
from recon.core.values.trajectory import Trajectory as Trajectory
from recon.core.values.truth import DepthMetrics as DepthMetrics
from recon.core.values.truth import DisparityMetrics as DisparityMetrics
from recon.core.values.truth import DisparityTruth as DisparityTruth
from recon.core.values.truth import GridMetrics as GridMetrics
from recon.core.values.truth import LengthErrors as LengthErrors
from recon.core.values.truth import MapMetrics as MapMetrics
from recon.core.values.truth import OccupancyMetrics as OccupancyMetrics
from recon.core.values.truth import OccupancyTruth as OccupancyTruth
from recon.core.values.truth import SequenceTruth as SequenceTruth
from recon.core.values.truth import TrajectoryMetrics as TrajectoryMetrics
from recon.core.values.truth import VoxelMetrics as VoxelMetrics
