"""`recon doctor`: check the installation.

It imports no library and no kernel itself: whatever lacks is to be found, and said.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from recon.run.installation import (
    PACKAGES,
    SYSTEM_LIBRARIES,
    Check,
    check_cores,
    check_data,
    check_disk,
    check_folder,
    check_kiss_icp_environment,
    check_memory,
    check_numba,
    check_opencv_threads,
    check_packages,
    check_python,
    check_system_libraries,
    run_python,
)

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
        check_python(),
        *check_packages(PACKAGES),
        *check_system_libraries(SYSTEM_LIBRARIES),
        check_cores(),
        check_memory(),
        check_opencv_threads(),
        *check_numba(),
        *check_kernels(),
        check_kiss_icp_environment(),
        check_data(),
        check_folder("results can be written", outputs, needed=True, hint="use --out"),
        check_disk(outputs),
    ]


def check_kernels() -> Iterator[Check]:
    """Run a kernel of each room that has some, and report what it lacks."""
    for room in sorted(folder.parent.name for folder in _ROOMS.glob("*/kernels")):
        sample = f"from recon.commands.kernel_samples import SAMPLES; SAMPLES[{room!r}]()"
        ran, printed = run_python(sample, _COMPILE_TIMEOUT_S)
        yield Check(
            f"kernels of {room}",
            ok=ran,
            found="run" if ran else printed,
            hint="" if ran else "install recon anew, with the versions of its constraints.txt",
        )
