"""Rectification from the images alone, where no calibration is known.

- `rectify.py`: the simplest change that aligns rows; `fundamental.py`: the geometry of two views;
- `homographies.py`: what aligns its rows, in the size and shape of the images.
"""
