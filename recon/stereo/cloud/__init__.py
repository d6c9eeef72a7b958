"""Filtered point clouds with uncertainties, from disparity maps."""
