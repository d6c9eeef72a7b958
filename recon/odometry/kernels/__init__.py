"""Compiled loops of bundle adjustment, with a reference implementation in numpy."""
