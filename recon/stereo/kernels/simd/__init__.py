"""SIMD vectors, for loops that the compiler does not vectorise itself.

A vector holds `LANES` neighbouring values of an array. Its functions are plain numpy (`vectors`),
which defines them and runs where numba is switched off; compiled, each becomes the LLVM
instructions registered for it (`instructions`, `transposition`). Kernels import what they need from
here and nothing from the modules behind. Explained in ``docs/simd.md``.
"""

from recon.stereo.kernels.simd import instructions, transposition
from recon.stereo.kernels.simd.vectors import (
    LANES,
    Vector,
    absolute_difference,
    broadcast_smallest,
    differing_bits,
    larger,
    load,
    load_row,
    mean,
    narrow,
    put_after,
    put_before,
    ramp,
    smaller,
    splat,
    store,
    store_row,
    transpose,
    where_equal,
    where_less,
    widen,
)

__all__ = [
    "LANES",
    "Vector",
    "absolute_difference",
    "broadcast_smallest",
    "differing_bits",
    "instructions",
    "larger",
    "load",
    "load_row",
    "mean",
    "narrow",
    "put_after",
    "put_before",
    "ramp",
    "smaller",
    "splat",
    "store",
    "store_row",
    "transpose",
    "transposition",
    "where_equal",
    "where_less",
    "widen",
]
