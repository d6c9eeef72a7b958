"""Evaluation of disparity maps, trajectories, clouds and occupancy against ground truth.

- `disparity.py`, `trajectory.py`, `map.py`, `occupancy.py`: one measure each, as pure functions;
- `segments.py`: where drift is measured; `association.py`: which poses belong together;
- `drive_errors.py`: a mapped drive beside the truth of its source; `map_comparison.py`: a map
  beside a cloud;
- `middlebury/bench.py`: the benchmark; `paper.py`: the seed paper's experiments.
"""
