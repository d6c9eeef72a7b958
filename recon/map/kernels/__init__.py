"""Compiled loops of occupancy and surfaces, each with a reference implementation in Python."""
