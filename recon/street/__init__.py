"""A rendered street drive with exact ground truth.

`build_street` lays out a street, `StreetCamera` renders it, and `truth` gives the true surfaces
and obstacles. Only the settings are imported here, as the rest needs Open3D.
"""
