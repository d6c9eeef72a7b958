"""Filtered point clouds with uncertainties, from disparity maps; Open3D thins and filters."""
