"""Loop closure: recognise a place, verify it by geometry, correct the path."""

from recon.places.settings import LoopSettings

__all__ = ["LoopSettings"]
