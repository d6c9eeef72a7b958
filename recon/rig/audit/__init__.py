"""Audit of a recording: what its images, its features and its motion say, and a verdict.

- `audit.py`: all of it, the corrected calibration, and the short check of a pair;
- `sample.py`: which frames are looked at, and the rows, swapped cameras and delays that they show;
  `measures.py`: what is measured in them; `row_alignment.py`: the rotation with which rows meet;
- `seen_motion.py`: features tracked through the drive; `corrections.py`: what they show
  of the rig, a turned right camera and bent lenses; `rig_fit.py`: the fit of both;
- `findings.py`: the problems found, with advice, and the verdict.
"""
