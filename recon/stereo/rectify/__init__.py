"""Calibrated rectification, checks of rectified pairs, and grey conversion."""
