"""Calibration files of several programs."""
