"""Filtered point clouds with uncertainties, from disparity maps."""

from recon.cloud.back_project import CloudSettings, back_project
from recon.cloud.edges import EdgeSettings, remove_flying_edges
from recon.cloud.filters import ANY_SCALE, FilterSettings, filter_cloud

__all__ = [
    "ANY_SCALE",
    "CloudSettings",
    "EdgeSettings",
    "FilterSettings",
    "back_project",
    "filter_cloud",
    "remove_flying_edges",
]
