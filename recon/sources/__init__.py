"""Sources of stereo pairs: one module per kind of input.

- `protocol.py`: what every source gives; `registry.py`: how the kind of a path is recognised;
- `kitti.py`, `euroc.py`, `tum.py`, `folders.py`, `video.py`, `bag.py`: one kind each;
- `images.py`, `pairing.py`, `times.py`, `calibration.py`: what several of them need;
- `one_pair.py`, `pair_input.py`: a single pair; `image_pairs.py`: images of two cameras by name;
- `datasets.py`, `fetching.py`: public data sets and how they are fetched.
"""
