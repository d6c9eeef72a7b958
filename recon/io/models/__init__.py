"""Clouds (`columns.py`: what formats call attributes), 3D Tiles, meshes, COLMAP, rasters."""
