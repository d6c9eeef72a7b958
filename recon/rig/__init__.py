"""Two cameras as one instrument: boards, calibration, audit, capture.

- `calibrate/board_views.py` finds the board, `calibrate/stereo.py` fits the rig, and
  `calibrate/verdict.py` judges it;
- `audit/audit.py`: is a recording good enough; `audit/pair_checks.py`: is a pair;
- `rectification.py`: `recon rectify`, by a calibration or, in `uncalibrated/rectify.py`, without;
- `capture.py`: pairs from cameras; `board_sheet.py`: a board to print.
"""
