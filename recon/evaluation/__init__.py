"""Evaluation of disparity maps, trajectories, clouds and occupancy against ground truth.

- `disparity.py`, `confidence.py`, `trajectory.py`, `map.py`, `occupancy.py`: one measure each, as
  pure functions; `segments.py`: which poses of two paths are compared;
- `drive_errors.py`: a mapped drive beside the truth of its source; `map_comparison.py`: a map
  beside a cloud; `map_of_run.py`: what its map says of itself;
- `middlebury/bench.py`: the benchmark; `paper.py`: the seed paper's experiments.
"""
