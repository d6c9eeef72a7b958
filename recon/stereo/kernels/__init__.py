"""Compiled loops of matching and back-projection, each with a reference implementation."""
