"""From a recorded pair to a cloud: rectification, matching, back-projection.

`frame.py` takes one pair through all of it, stage by stage, and makes points of disparities:

- `observe.py`: what was recorded becomes a view with a disparity; of two images, by:
- `rectify/rectifier.py`: both images are warped so that matching pixels share a row;
- `match/registry.py`: the matchers by name; ours are `match/sad.py`, `match/sgm.py` and
  `match/fine.py`.

The loops are in `kernels/`. `rectify/` also has what calibration and audit need of cameras: lenses
(`rectify/lens.py`, `rectify/closed.py`), epipolar lines, matched features.
"""
