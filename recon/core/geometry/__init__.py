"""Geometry as pure functions: rigid transforms, and alignment."""
