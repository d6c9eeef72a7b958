"""`recon doctor`: check the installation.

It imports no library and no kernel itself: whatever lacks is to be found, and said.
"""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from recon.core.errors import DISTRIBUTION
from recon.core.kernels.cache import cache_parent
from recon.core.machine import available_cores
from recon.core.progress import stage, tracked


def examine(outputs: Path = Path("outputs")) -> list[Check]:
    """Check Python, packages, system libraries, machine and folders, and whether LLVM compiles.

    Each package has a process of its own, so that a crash is reported as well. The folder that runs
    write to need not exist, and is not created.
    """
    return [*tracked(_examined(outputs), "checks", "examine")]


def _examined(outputs: Path) -> Iterator[Check]:
    yield from check_packages()
    yield from (check_library(*one) for one in SYSTEM_LIBRARIES.items() if sys.platform == "linux")
    yield from check_machine()
    yield from check_kernels()
    yield from check_environment()
    yield check_folder("results can be written", outputs, "use --out", needed=True)
    yield check_size("free disk space", shutil.disk_usage(_nearest(outputs)).free, _DISK)


def check_kernels() -> Iterator[Check]:
    """Check whether kernels can be compiled and kept, and say how many are; none is compiled."""
    off = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
    found = "off: NUMBA_DISABLE_JIT is set" if off else "on"
    hint = "unset NUMBA_DISABLE_JIT; runs take hours with it"
    yield Check("compiled kernels", not off, found, hint, needed=False)
    hint = "set NUMBA_CACHE_DIR to a folder that can be written"
    yield check_folder("kernels can be cached", cache_parent(), hint, needed=False)
    stage("compile one line")
    ran, printed = run_python(_COUNT_KERNELS)
    yield Check(
        "kernels", ran, printed, "install recon anew, with the versions of its constraints.txt"
    )


# LLVM compiles something, so that a processor or library that it does not suit is found.
_COUNT_KERNELS: Final = """
from numba import njit
from recon.commands.kernels import missing_calls, recorded_calls
assert njit(lambda value: value + 1)(1) == 2
lack, calls = len(missing_calls()), len(recorded_calls())
print(f"{calls - lack} of {calls} compiled; others are when a command needs them")
"""
# GB that are needed, and what to do where there is less
_MEMORY: Final = (3.0, "long drives need 3 GB: map fewer frames")
_DISK: Final = (1.0, "free some space, or use --out on another disk")
_NO_DATA: Final = "not set; only tests and benchmarks use it"
_TIMEOUT_S: Final = 120.0
#: Package name -> module name.
PACKAGES: Final[Mapping[str, str]] = {
    "numpy": "numpy", "llvmlite": "llvmlite", "numba": "numba", "opencv-python-headless": "cv2",
    "open3d": "open3d", "kiss-icp": "kiss_icp", "pymeshlab": "pymeshlab", "pillow": "PIL",
    "jinja2": "jinja2", "matplotlib": "matplotlib", "plotly": "plotly", "pydantic": "pydantic",
    "typer": "typer", "rich": "rich", "pyyaml": "yaml", "scipy": "scipy",
    "threadpoolctl": "threadpoolctl", "typing-extensions": "typing_extensions",
    **({} if sys.version_info >= (3, 11) else {"tomli": "tomli"}),
}  # fmt: skip
#: Shared library -> Debian or Ubuntu package that provides it.
SYSTEM_LIBRARIES: Final[Mapping[str, str]] = {
    "libGL.so.1": "libgl1", "libEGL.so.1": "libegl1", "libX11.so.6": "libx11-6",
    "libusb-1.0.so.0": "libusb-1.0-0", "libOpenGL.so.0": "libopengl0",
}  # fmt: skip


@dataclass(frozen=True)
class Check:
    """What was checked and found, and what to do if it failed; runs fail without what is needed."""

    name: str
    ok: bool
    found: str
    hint: str = ""
    needed: bool = True

    def __post_init__(self) -> None:
        if self.ok:
            object.__setattr__(self, "hint", "")


def check_packages() -> Iterator[Check]:
    """Check Python, and whether each package can be imported."""
    new = sys.version_info >= (3, 10)
    yield Check("Python", new, platform.python_version(), "install Python >= 3.10")
    yield check_name()
    with ThreadPoolExecutor(max_workers=available_cores()) as pool:
        yield from pool.map(check_package, PACKAGES, PACKAGES.values())


def check_name() -> Check:
    """Check that no other project is installed whose import package has the name of ours."""
    hint = f"run: pip uninstall recon; then install {DISTRIBUTION} again"
    try:
        found = f"recon {version('recon')} is another project, with files at the places of ours"
    except PackageNotFoundError:
        return Check(DISTRIBUTION, ok=True, found="nothing else has its import name")
    return Check(DISTRIBUTION, ok=False, found=found, hint=hint)


def check_package(name: str, module: str) -> Check:
    """Check one package, imported in its own process."""
    try:
        installed = version(name)
    except PackageNotFoundError:
        return Check(name, ok=False, found="not installed", hint=f"run: pip install {name}")
    done, printed = run_python(f"import {module}")
    again = "pip install --force-reinstall"
    lacks = (package for library, package in SYSTEM_LIBRARIES.items() if library in printed)
    hint = next((f"run: apt-get install {package}" for package in lacks), f"run: {again} {name}")
    return Check(name, done, installed if done else f"{installed}, {printed}", hint)


def check_library(library: str, package: str) -> Check:
    """Check whether a shared library loads, which packages need."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return Check(library, ok=False, found="missing", hint=f"run: apt-get install {package}")
    return Check(library, ok=True, found="loads")


def check_machine() -> Iterator[Check]:
    """Check cores, memory and OpenCV's number of threads."""
    yield Check("cores", ok=True, found=str(available_cores()), needed=False)
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not available on this system
        yield Check("memory", ok=True, found="unknown", needed=False)
    else:
        yield check_size("memory", memory, _MEMORY)
    done, printed = run_python("import cv2; print(cv2.getNumThreads())")
    found = printed if done else "unknown"
    yield Check("OpenCV threads", done, found, "see opencv", needed=False)


def check_environment() -> Iterator[Check]:
    """Check variables that would silently change kiss-icp's settings, and that of real data."""
    names = sorted(name for name in os.environ if name.lower().startswith("kiss_icp"))
    found, hint = ", ".join(names) or "none set", f"unset {' '.join(names)}"
    yield Check("kiss-icp variables", not names, found, hint, needed=False)
    folder, hint = os.environ.get("RECON_DATA"), "set RECON_DATA to a folder, or unset it"
    ok = not folder or Path(folder).is_dir()
    found = (folder if ok else f"{folder} is no folder") or _NO_DATA
    yield Check("real data (RECON_DATA)", ok, found, hint, needed=False)


def check_folder(name: str, folder: Path, hint: str, *, needed: bool) -> Check:
    """Check whether a folder, or the one that it would be created in, is writable."""
    nearest = _nearest(folder)
    try:
        with tempfile.TemporaryFile(dir=nearest):
            return Check(name, ok=True, found=str(folder.absolute()), needed=needed)
    except OSError as error:
        found = f"{nearest.absolute()}: {error.strerror or error}"
        return Check(name, ok=False, found=found, hint=hint, needed=needed)


def check_size(name: str, size: int, least: tuple[float, str]) -> Check:
    """Check whether there is enough memory or disk, in bytes."""
    least_gb, hint = least
    return Check(name, size >= 1e9 * least_gb, f"{size / 1e9:.1f} GB", hint, needed=False)


def _nearest(folder: Path) -> Path:
    return next((path for path in (folder, *folder.absolute().parents) if path.exists()), Path())


def run_python(code: str, timeout_s: float = _TIMEOUT_S) -> tuple[bool, str]:
    """Run code in a new Python process: whether it ran, and the last line that it printed."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, errors="replace",
            timeout=timeout_s, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return False, f"no answer in {timeout_s:g} s"
    if done.returncode < 0:
        return False, f"crashed with signal {-done.returncode}"
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    return done.returncode == 0, lines[-1] if lines else ""
