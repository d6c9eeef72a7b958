"""Audit of a recording: what its images, its features and its motion say, and a verdict.

- `audit.py`: all of it, and the calibration that is written where it can be corrected;
  `pair_checks.py`: the same for one pair;
- `sample.py`: which frames are looked at; `measures.py`: what is measured in them;
- `geometry.py`: rows, swapped cameras and delays, from the features of all pairs;
  `row_alignment.py`: the small rotation with which rows meet;
- `seen_motion.py`: features tracked through stretches of the drive, and what they show of the rig:
  how the right camera is turned (`right_turn.py`), and what the lenses bend (`bent_lenses.py`),
  both by one fit (`rig_fit.py`);
- `findings.py`: the problems found, with advice, and the verdict.
"""
