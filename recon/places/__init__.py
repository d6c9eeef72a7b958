"""Loop closure: recognise a place, verify it by geometry, correct the path.

- `loop.py`: two frames that show one place, and loops that confirm each other;
- `keyframe.py`: what is kept of a frame; `places.py`: which keyframes look alike and may be near,
  as far as odometry drifts;
- `verify.py`: whether two of them are a loop, and the motion between them (`align.py`);
- `detector.py`: all this during a drive, or in a map that is there already;
- `closure.py`: the path corrected by loops; `fixes.py`: by measured positions.
"""
