"""Loop closure: recognise a place, verify it by geometry, correct the path.

- `loop.py`: two frames that show one place; `keyframe.py`: what is kept of a frame; `places.py`:
  which keyframes look alike and may be near;
- `verify.py`: whether two of them are a loop, and the motion between them (`align.py`);
- `path_fit.py`: what of a misfit to measured positions drift and noise explain;
- `agree.py`: loops that confirm each other; `closure.py`: the path corrected by them;
- `detector.py`: all this during a drive; `known_places.py`: in a map that is there already.
"""
