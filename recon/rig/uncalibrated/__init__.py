"""Rectification from the images alone, where no calibration is known.

- `rectify.py`: all of it; `fundamental.py`: the geometry of the two views, from matched features;
- `shaping.py`: what aligned rows leave open: scale, shear, and the smallest disparity.
"""
