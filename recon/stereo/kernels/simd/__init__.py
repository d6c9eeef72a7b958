"""SIMD vectors, for loops that the compiler does not vectorise itself.

A vector holds `LANES` neighbouring values of an array. Its functions are plain numpy (`vectors`),
which defines them and runs where numba is switched off; compiled, each becomes the LLVM
instructions registered for it (`instructions`). Explained in ``docs/architecture.md``.
"""

import recon.stereo.kernels.simd.instructions  # noqa: F401 - registers them
