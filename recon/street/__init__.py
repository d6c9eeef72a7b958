"""A rendered drive down a street, or walk through a room (`room`), with exact ground truth.

`build_street` lays it out, `StreetCamera` renders it, and `truth` gives the true surfaces
and obstacles. Only the settings are imported here, as the rest needs Open3D.
"""
