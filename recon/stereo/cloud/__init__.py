"""Filtered point clouds with uncertainties, from disparity maps.

`back_project.py`: pixels that float between surfaces are dropped, disparities become points with a
depth error, which are thinned and filtered by Open3D (`open3d_clouds.py`).
"""
