"""Point clouds (`columns.py`: what formats call attributes) and meshes; COLMAP, bags of ROS 2."""
