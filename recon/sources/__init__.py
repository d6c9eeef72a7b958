"""Sources of stereo pairs: one module per kind of input.

- `source.py`: the base class of every source, which frames are pairs, a part of a drive;
  `registry.py`: the kinds;
- `kitti.py`, `listed.py` (EuRoC, TUM), `folders.py`, `video.py`, `bag.py`, `one_pair.py`,
  `synthetic.py`: one kind each, or two alike;
- `rgbd.py`: an image and its depth, which needs no matching;
- `images.py`: drives in image files, which `image_names.py` and `times.py` pair;
- `calibration.py`: which calibration is used;
- `live.py`: a drive that arrives in its own time; `opencv_camera.py`; `bag_prior.py`;
- `datasets.py`: public data sets and how they are fetched.
"""
