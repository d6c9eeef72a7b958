"""Readers and writers of file formats; foreign conventions are converted here and nowhere else.

- `cameras/calibration.py` recognises any calibration file; beside it are formats; most are known by
  what is in them: `cameras/contents.py` reads it, `cameras/named.py` finds the rig by its names;
- `images/image.py`: images; `images/disparity.py`: disparity maps; `middlebury.py`: whole scenes;
- `ros/`: messages of ROS, in bags and on a network;
- `models/`: clouds, meshes, OctoMap, maps from above; `trajectory.py`: poses; `imu.py`;
- `files.py`: what a parser raises becomes one error that names the file; `fields.py`: YAML,
  TOML, typed fields; `atomic.py`: files appear whole or not at all; `download.py`: data sets.
"""
