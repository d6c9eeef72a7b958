"""Rectification from the images alone, where no calibration is known."""
