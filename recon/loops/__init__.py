"""Loop closure: recognise a place, prove it by geometry, bend the path so that it closes."""

from recon.loops.settings import LoopSettings

__all__ = ["LoopSettings"]
