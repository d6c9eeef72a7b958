"""Filtered point clouds with uncertainties, from disparity maps.

- `edges.py`: pixels between a foreground and its background are dropped;
- `back_project.py`: disparities become points with a depth error;
- `filters.py`: thinning and outliers, by Open3D (`open3d_clouds.py`).
"""
