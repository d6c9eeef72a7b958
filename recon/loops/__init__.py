"""Loop closure: recognise a place, verify it by geometry, correct the path."""

from recon.loops.settings import LoopSettings

__all__ = ["LoopSettings"]
