"""Sources of stereo pairs: one module per kind of input.

- `source.py`: the base class of every source, which frames are pairs, a part of a drive;
  `registry.py`: the kinds;
- `kitti.py`, `listed.py` (EuRoC, TUM, RGB-D), `folders.py`, `video.py`, `bag.py`, `one_pair.py`,
  `synthetic.py`: one kind each, or two alike;
- `topics.py`: which topics of a bag or network are a camera's; `ros2.py`: those of a network;
- `images.py`: drives in image files, paired by name or, in `times.py`, by time;
- `calibration.py`: which calibration is used; `live.py`: cameras, and drives that are played;
- `datasets.py`: public data sets and how they are fetched.
"""
