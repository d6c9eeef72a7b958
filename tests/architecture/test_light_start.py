"""The command line answers at once: heavy libraries load only when a command needs them."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

HEAVY = {
    "cv2", "kiss_icp", "matplotlib", "numba", "open3d", "plotly", "pymeshlab", "pyoctomap",
}  # fmt: skip
PROBE = """
import sys
sys.argv = ["recon", "--help"]
from recon.cli import main
try:
    main()
except SystemExit:
    pass
print("LOADED", *sys.modules)
"""


def test_help_loads_no_heavy_library() -> None:
    done = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, check=True)

    _, _, loaded = done.stdout.rpartition("LOADED")
    assert HEAVY & set(loaded.split()) == set()


def test_import_of_the_package_loads_no_heavy_library() -> None:
    probe = "import recon, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)

    assert HEAVY & set(done.stdout.split()) == set()


def test_help_answers_within_half_a_second() -> None:
    """The fastest of some tries counts: the others tell how busy the machine is."""
    program = str(Path(sys.executable).with_name("recon"))
    for _ in range(10):
        start_s = time.perf_counter()
        subprocess.run([program, "--help"], capture_output=True, check=True)
        duration_s = time.perf_counter() - start_s
        if duration_s < 0.5:
            return
    raise AssertionError(f"the last try took {duration_s:.2f} s")
