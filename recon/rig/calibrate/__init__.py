"""Stereo calibration from images of a board."""
