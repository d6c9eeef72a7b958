"""Audit of a recording: what its images, features and motion (`recon.odometry.rig`) say; a verdict.

- `audit.py`: all of it, the corrected calibration, and the short check of a pair;
- `sample.py`: which frames are looked at, and the rows, swapped cameras and delays that they show;
  `measures.py`: what is measured in them;
- `findings.py`: the problems found, with advice, and the verdict.

What the motion shows of the rig is `recon.odometry.rig`.
"""
