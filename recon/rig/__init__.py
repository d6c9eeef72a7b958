"""Two cameras as one instrument: boards, calibration, audit, capture."""
