"""The command line starts fast: heavy libraries are imported only when a command needs them."""

from __future__ import annotations

import subprocess
import sys

from recon.commands.doctor import PACKAGES

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
"""


def loaded(probe: str) -> set[str]:
    """The modules that a process has loaded at its end."""
    command = [sys.executable, "-c", f"{probe}\nimport sys; print('LOADED', *sys.modules)"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(done.stdout.rpartition("LOADED")[2].split())


def test_help_loads_the_shells_and_neither_libraries_nor_numbers_nor_settings() -> None:
    """What it takes is measured by `benchmarks/two_checkouts.py`; this is what makes it little."""
    found = loaded(PROBE)
    assert found.isdisjoint(HEAVY | {"numpy", "pydantic", "scipy", "dask"})
    rooms = {name.split(".")[1] for name in found if name.startswith("recon.")}
    assert rooms == {"cli", "core"}


def test_import_of_the_package_loads_no_heavy_library() -> None:
    assert loaded("import recon").isdisjoint(HEAVY)


def test_the_process_that_meshes_loads_nothing_that_it_does_not_use() -> None:
    """There is one for each tile of a surface."""
    assert loaded("import recon.export.pymeshlab").isdisjoint(HEAVY)


def test_doctor_loads_nothing_whose_lack_it_reports() -> None:
    shell = {"typer", "rich", "typing_extensions"}  # without these there is no command line
    found = loaded("import recon.cli.getting_started, recon.commands.doctor")
    assert found & set(PACKAGES.values()) <= shell
