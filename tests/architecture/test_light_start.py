"""The command line starts fast: heavy libraries are imported only when a command needs them."""

from __future__ import annotations

import subprocess
import sys

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


def test_the_process_that_meshes_loads_nothing_that_it_does_not_use() -> None:
    """There is one for each tile of a surface."""
    probe = "import recon.export.pymeshlab, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)

    assert HEAVY & set(done.stdout.split()) == set()


def test_help_loads_the_shells_and_neither_numbers_nor_settings() -> None:
    """What it takes is measured by `benchmarks/against.py`; this is what makes it little."""
    done = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, check=True)

    _, _, loaded = done.stdout.rpartition("LOADED")
    assert {"numpy", "pydantic", "scipy", "dask"}.isdisjoint(loaded.split())
    rooms = {name.split(".")[1] for name in loaded.split() if name.startswith("recon.")}
    assert rooms == {"cli", "core"}
