"""Point clouds (`columns.py`: what formats call attributes), meshes, COLMAP, bags of ROS 2."""
