"""The rig as the motion of a drive shows it.

- `tracks.py`: features in both images of a few windows of frames;
- `fault.py`: what may be wrong with a rig, as parameters, and the calibration without it;
- `fit.py`: the parameters that make disparities fit the motion, and rows meet;
- `rigidity.py`: whether both cameras are rigid to each other;
- `length.py`: the baseline, where lengths were measured that show it;
- `refine.py`: the refined rig of a drive, how it differs from the one given, and how well it is
  known.
"""
