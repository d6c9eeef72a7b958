"""Where a drive is in a map that is there already: recognised first, then tracked.

- `sequence.py`: a whole drive; `localizer.py`: frame by frame, search or track, or a single pair;
- `belief.py`: the pose and its covariance, from one frame to the next;
- `surroundings.py`: the pose corrected by the surfaces of the map, where it is worth it.
"""
