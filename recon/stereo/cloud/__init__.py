"""Filtered point clouds with uncertainties, from disparity maps."""

from recon.stereo.cloud.back_project import CloudSettings, back_project
from recon.stereo.cloud.edges import remove_flying_edges
from recon.stereo.cloud.filters import ANY_SCALE, FilterSettings, filter_cloud

__all__ = [
    "ANY_SCALE",
    "CloudSettings",
    "FilterSettings",
    "back_project",
    "filter_cloud",
    "remove_flying_edges",
]
