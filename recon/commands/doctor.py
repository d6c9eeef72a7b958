"""`recon doctor`: check the installation.

It imports no library and no kernel itself: whatever lacks is to be found, and said.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from recon.core.kernels.cache import cache_parent
from recon.run import installation
from recon.run.installation import SYSTEM_LIBRARIES, Check, check_folder, check_library, run_python

_ROOMS: Final = Path(__file__).parents[1]
_COMPILE_TIMEOUT_S: Final = 600.0


def examine(outputs: Path = Path("outputs")) -> list[Check]:
    """Check Python, packages, system libraries, machine and folders, and run some kernels.

    Each package is imported in a process of its own, so that a crash is reported as well; this
    takes some seconds. So does each kernel: more where they are not compiled.

    Args:
        outputs: The folder that runs write to; it need not exist, and is not created.
    """
    return [
        *installation.check_packages(),
        *(check_library(*one) for one in SYSTEM_LIBRARIES.items() if sys.platform == "linux"),
        *installation.check_machine(),
        *check_kernels(),
        *installation.check_environment(),
        check_folder("results can be written", outputs, "use --out", needed=True),
        installation.check_disk(outputs),
    ]


def check_kernels() -> Iterator[Check]:
    """Check whether kernels are compiled and kept, and run one of each room that has some."""
    off = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
    found = "off: NUMBA_DISABLE_JIT is set" if off else "on"
    hint = "unset NUMBA_DISABLE_JIT; runs take hours with it"
    yield Check("compiled kernels", not off, found, hint, needed=False)
    hint = "set NUMBA_CACHE_DIR to a folder that can be written, or each run compiles anew"
    yield check_folder("kernels can be cached", cache_parent(), hint, needed=False)
    for room in sorted(folder.parent.name for folder in _ROOMS.glob("*/kernels")):
        sample = f"from recon.commands.kernel_samples import SAMPLES; SAMPLES[{room!r}]()"
        ran, printed = run_python(sample, _COMPILE_TIMEOUT_S)
        hint = "install recon anew, with the versions of its constraints.txt"
        yield Check(f"kernels of {room}", ran, "run" if ran else printed, hint)
