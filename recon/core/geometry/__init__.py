"""Geometry as pure functions: rigid transforms, projection, triangulation and depth error."""
