"""The map of drives: what is kept of them on disk."""

from recon.map.store import Key, Store

__all__ = ["Key", "Store"]
