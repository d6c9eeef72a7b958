"""Point clouds (`columns.py`: what formats call attributes), meshes, COLMAP, maps from above."""
