"""Two cameras as one instrument: boards, calibration, audit, capture.

- `calibrate/board_views.py` finds the board, `calibrate/stereo.py` fits the rig, and
  `calibrate/verdict.py` judges it;
- `audit.py`: is a recording, or a pair, good enough (`recon.look`); the corrected calibration;
- `rectification.py`: `recon rectify`, by a calibration or, in `uncalibrated.py`, without;
- `capture.py`: pairs from cameras, recorded or as a source;
- `board_sheet.py`: a board to print; `settings.py`: what calibration and audit can be set to.
"""
