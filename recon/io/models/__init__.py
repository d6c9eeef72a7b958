"""Point clouds and meshes; models of COLMAP, bags of ROS 2."""
