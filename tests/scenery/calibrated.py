"""The figures of a calibration of which nothing is to be said."""

from recon.rig.calibrate.figures import CalibrationFigures, WorkingError

GOOD = CalibrationFigures(
    board="chess:9x6:25mm", width_px=640, height_px=480,
    stereo_rms_px=0.2, left_rms_px=0.2, right_rms_px=0.2,
    epipolar_px=0.1, epipolar_95_px=0.3, baseline_m=0.12, baseline_interval_m=[0.119, 0.121],
    baseline_squares=4.8, focal_px=500.0, focal_interval_px=[499.0, 501.0], focal_right_px=500.0,
    rotation_spread_deg=0.1, views=25, views_used=25, views_repeated=[], views_dropped=[],
    dropped_error_px={}, pictures_without_board=[], view_errors_px={}, coverage_left=0.9,
    coverage_right=0.9, tilt_max_deg=30.0, tilted_ratio=0.7, far_to_near=3.0, depth_error_cm={},
    working_error=WorkingError(4.0, 0.01, 0.02), rectified_focal_px=500.0,
)  # fmt: skip
