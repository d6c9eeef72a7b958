"""Compiled loops (numba): arrays and scalars in and out, and where machine code is kept."""
