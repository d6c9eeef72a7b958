"""Stereo reconstruction and mapping: from pairs of pictures to maps."""

from __future__ import annotations

__version__ = "0.1.0"
