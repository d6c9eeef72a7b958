"""Sources of stereo pairs: one module per kind of input.

- `protocol.py`: what every source gives; `registry.py`: how the kind of a path is recognised;
- `kitti.py`, `euroc.py`, `tum.py`, `folders.py`, `video.py`, `bag.py`: one kind each;
- `images.py`: drives in image files, which `image_names.py` and `stamps.py` pair;
- `frame_list.py`: which frames are pairs, and which of them are used; `times.py`, `calibration.py`;
- `part.py`, `live.py`: a part of a drive, and a drive that arrives in its own time;
- `one_pair.py`, `pair_input.py`: a single pair; `image_pairs.py`: images of two cameras by name;
- `datasets.py`, `fetching.py`: public data sets and how they are fetched.
"""
