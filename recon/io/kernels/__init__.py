"""Compiled loops of file formats."""
