"""Loop closure: recognise a place, verify it by geometry, correct the path.

- `keyframe.py`: what is kept of a frame; `places.py`: which keyframes look alike and may be near,
  as far as odometry drifts, and loops that confirm each other;
- `verify.py`: whether two of them are a loop, and the motion between them;
- `detector.py`: all this during a drive, or in a map that is there already;
- `closure.py`: the path corrected by loops (`pose_graph.py`, also by measured positions);
  `adjustment.py`: adjusted with the points that keyframes share.
"""
