"""Checks of the installation and the machine, each of which says what to do."""

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
from types import MappingProxyType
from typing import Final

from recon.core.kernels.cache import cache_parent
from recon.run.machine import available_cores

MIN_PYTHON: Final = (3, 10)
MIN_MEMORY_GB: Final = 3.0
MIN_DISK_GB: Final = 1.0
_TIMEOUT_S: Final = 120.0

# Package name -> module name.
PACKAGES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "numpy": "numpy",
        "llvmlite": "llvmlite",
        "numba": "numba",
        "opencv-python-headless": "cv2",
        "open3d": "open3d",
        "kiss-icp": "kiss_icp",
        "pymeshlab": "pymeshlab",
        "pillow": "PIL",
        "jinja2": "jinja2",
        "matplotlib": "matplotlib",
        "plotly": "plotly",
        "pydantic": "pydantic",
        "typer": "typer",
        "rich": "rich",
        "pyyaml": "yaml",
        "threadpoolctl": "threadpoolctl",
        "typing-extensions": "typing_extensions",
        **({} if sys.version_info >= (3, 11) else {"tomli": "tomli"}),
    }
)
# Shared library -> Debian or Ubuntu package that provides it.
SYSTEM_LIBRARIES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "libGL.so.1": "libgl1",
        "libEGL.so.1": "libegl1",
        "libX11.so.6": "libx11-6",
        "libusb-1.0.so.0": "libusb-1.0-0",
        "libOpenGL.so.0": "libopengl0",
    }
)


@dataclass(frozen=True)
class Check:
    """The result of one check.

    Attributes:
        name: What was checked.
        ok: Whether it passed.
        found: What was found.
        hint: What to do if it failed, else "".
        needed: Whether runs fail without it; else it is optional.
    """

    name: str
    ok: bool
    found: str
    hint: str = ""
    needed: bool = True


def check_python() -> Check:
    """Check the version of Python."""
    least = ".".join(map(str, MIN_PYTHON))
    ok = sys.version_info >= MIN_PYTHON
    return Check(
        "Python", ok, platform.python_version(), "" if ok else f"install Python >= {least}"
    )


def check_packages(packages: Mapping[str, str]) -> list[Check]:
    """Check the version of each package, and whether it can be imported."""
    with ThreadPoolExecutor(max_workers=available_cores()) as pool:
        return list(pool.map(check_package, packages, packages.values()))


def check_package(name: str, module: str) -> Check:
    """Check one package, imported in its own process."""
    try:
        installed = version(name)
    except PackageNotFoundError:
        return Check(name, ok=False, found="not installed", hint=f"run: pip install {name}")
    done, printed = run_python(f"import {module}")
    if done:
        return Check(name, ok=True, found=installed)
    return Check(name, ok=False, found=f"{installed}, {printed}", hint=_import_hint(name, printed))


def check_system_libraries(libraries: Mapping[str, str]) -> list[Check]:
    """Check the shared libraries that the packages load; none outside Linux."""
    if sys.platform != "linux":
        return []
    return [_check_library(library, package) for library, package in libraries.items()]


def check_cores() -> Check:
    """Count the CPU cores available to this process."""
    return Check("cores", ok=True, found=str(available_cores()), needed=False)


def check_memory() -> Check:
    """Check the memory of the machine."""
    try:
        memory_gb = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
    except (AttributeError, ValueError, OSError):  # not available on this system
        return Check("memory", ok=True, found="unknown", needed=False)
    ok = memory_gb >= MIN_MEMORY_GB
    hint = "" if ok else f"long drives need {MIN_MEMORY_GB:g} GB: map fewer frames"
    return Check("memory", ok, f"{memory_gb:.1f} GB", hint, needed=False)


def check_opencv_threads() -> Check:
    """Ask OpenCV for its default number of threads."""
    done, printed = run_python("import cv2; print(cv2.getNumThreads())")
    found = printed if done else "unknown"
    return Check("OpenCV threads", done, found, "" if done else "see opencv", needed=False)


def check_numba() -> Iterator[Check]:
    """Check whether kernels are compiled, and whether machine code is kept for the next run."""
    off = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
    yield Check(
        "compiled kernels",
        ok=not off,
        found="off: NUMBA_DISABLE_JIT is set" if off else "on",
        hint="unset NUMBA_DISABLE_JIT; runs take hours with it" if off else "",
        needed=False,
    )
    yield check_folder(
        "kernels can be cached",
        cache_parent(),
        needed=False,
        hint="set NUMBA_CACHE_DIR to a folder that can be written, or each run compiles anew",
    )


def check_kiss_icp_environment() -> Check:
    """Check for variables ``kiss_icp_…``, which would silently change kiss-icp's settings."""
    names = sorted(name for name in os.environ if name.lower().startswith("kiss_icp"))
    hint = f"unset {' '.join(names)}" if names else ""
    found = ", ".join(names) or "none set"
    return Check("kiss-icp variables", not names, found, hint, needed=False)


def check_data() -> Check:
    """Check the folder of real data that tests and benchmarks use."""
    name, folder = "real data (RECON_DATA)", os.environ.get("RECON_DATA")
    if not folder:
        return Check(name, ok=True, found="not set; only tests and benchmarks use it", needed=False)
    ok = Path(folder).is_dir()
    hint = "" if ok else "set RECON_DATA to a folder, or unset it"
    return Check(name, ok, folder if ok else f"{folder} is no folder", hint, needed=False)


def check_folder(name: str, folder: Path, *, needed: bool, hint: str) -> Check:
    """Check whether a folder, or the one that it would be created in, is writable."""
    nearest = next((p for p in (folder, *folder.absolute().parents) if p.exists()), Path())
    try:
        with tempfile.TemporaryFile(dir=nearest):
            return Check(name, ok=True, found=str(folder.absolute()), needed=needed)
    except OSError as error:
        found = f"{nearest.absolute()}: {error.strerror or error}"
        return Check(name, ok=False, found=found, hint=hint, needed=needed)


def check_disk(folder: Path) -> Check:
    """Check the free disk space for results."""
    nearest = next((p for p in (folder, *folder.absolute().parents) if p.exists()), Path())
    free_gb = shutil.disk_usage(nearest).free / 1e9
    ok = free_gb >= MIN_DISK_GB
    hint = "" if ok else "free some space, or use --out on another disk"
    return Check("free disk space", ok, f"{free_gb:.1f} GB", hint, needed=False)


def run_python(code: str, timeout_s: float = _TIMEOUT_S) -> tuple[bool, str]:
    """Run code in a new Python process: whether it ran, and the last line that it printed."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False, f"no answer in {timeout_s:g} s"
    if done.returncode < 0:
        return False, f"crashed with signal {-done.returncode}"
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    return done.returncode == 0, lines[-1] if lines else ""


def _check_library(library: str, package: str) -> Check:
    try:
        ctypes.CDLL(library)
    except OSError:
        return Check(library, ok=False, found="missing", hint=f"run: apt-get install {package}")
    return Check(library, ok=True, found="loads")


def _import_hint(name: str, printed: str) -> str:
    for library, package in SYSTEM_LIBRARIES.items():
        if library in printed:
            return f"run: apt-get install {package}"
    return f"run: pip install --force-reinstall {name}"
