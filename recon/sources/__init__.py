"""Sources of stereo pairs: one module per kind of input."""

from recon.sources.prior import ReadPrior, read_prior
from recon.sources.protocol import IncompleteSource, KnowsOccupancy, StampedSource, StereoSource
from recon.sources.registry import SOURCES, open_source, recognise_source
from recon.sources.settings import SourceSettings

__all__ = [
    "SOURCES",
    "IncompleteSource",
    "KnowsOccupancy",
    "ReadPrior",
    "SourceSettings",
    "StampedSource",
    "StereoSource",
    "open_source",
    "read_prior",
    "recognise_source",
]
