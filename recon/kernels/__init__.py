"""Compiled loops (numba): arrays and scalars in and out, each with a readable numpy twin."""
