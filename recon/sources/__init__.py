"""Where stereo pairs come from: one class per kind of input."""

from recon.sources.protocol import StereoSource
from recon.sources.registry import SOURCES, open_source

__all__ = ["SOURCES", "StereoSource", "open_source"]
