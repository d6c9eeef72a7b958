"""Where a drive is in a map that is there already: recognised first, then tracked.

- `sequence.py`: a whole drive, or one pair; `localizer.py`: frame by frame, search or track;
- `search.py`: the first fix; `belief.py`: the pose and its covariance, from one frame to the next;
- `surroundings.py`: the pose corrected by the surfaces of the map (`surfaces.py`), where that is
  worth it (`gate.py`);
- `localize_run.py`: the result of a run.
"""
