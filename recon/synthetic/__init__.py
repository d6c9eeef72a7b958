"""A rendered street drive with exact truth, and planes with exact disparity.

`build_street` lays out a street, `StreetCamera` photographs it, `truth` gives the surfaces and
the obstacles that were really there. Only the settings are imported here: the rest needs Open3D.
"""

from recon.synthetic.settings import StreetSettings

__all__ = ["StreetSettings"]
