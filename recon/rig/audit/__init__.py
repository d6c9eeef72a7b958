"""Audit of a recording: measures of images and matched features, and a verdict on usability."""
