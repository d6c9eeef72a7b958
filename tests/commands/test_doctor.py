"""`recon doctor` finds what is missing, and compiles what a first run would."""

import io
import itertools
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import pytest
from rich.console import Console

import recon
from recon.cli.tables import print_checks
from recon.commands import doctor
from recon.commands.doctor import Check, check_kernels, examine
from recon.commands.kernels import recorded_calls


def test_this_machine_is_examined_and_ready(tmp_path):
    checks = examine(tmp_path / "outputs")
    assert [check for check in checks if check.needed and not check.ok] == []
    names = {check.name for check in checks}
    assert {"Python", "numpy", "open3d", "kernels", "memory", "cores"} <= names
    assert not (tmp_path / "outputs").exists()


def test_another_project_of_our_import_name_is_reported(monkeypatch):
    monkeypatch.setattr(doctor, "version", lambda name: {"recon": "0.0.4"}[name])
    found = doctor.check_name()
    assert (found.ok, found.needed) == (False, True)
    assert "recon 0.0.4 is another project" in found.found
    assert "pip uninstall recon" in found.hint


@pytest.fixture
def with_modules(tmp_path, monkeypatch):
    """Adds modules to what processes find before all others."""
    paths = os.pathsep.join([str(tmp_path), str(Path(recon.__file__).parents[1])])
    monkeypatch.setenv("PYTHONPATH", paths)
    return tmp_path


def test_what_kernels_lack_is_named(with_modules):
    (with_modules / "llvmlite.py").write_text("raise ImportError('half of it is gone')")
    (check,) = (check for check in check_kernels() if check.needed)
    assert (check.name, check.ok) == ("kernels", False)
    assert check.found == "ImportError: half of it is gone"
    assert "constraints.txt" in check.hint


def test_kernels_are_counted_and_none_is_compiled(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.delenv("NUMBA_DISABLE_JIT", raising=False)
    (check,) = (check for check in check_kernels() if check.needed)
    assert check.ok
    assert check.found.startswith(f"0 of {len(recorded_calls())} compiled")
    assert list(tmp_path.rglob("*.nbi")) == []


def test_what_is_missing_says_what_to_do(monkeypatch):
    missing = doctor.check_package("no-such-package", "no_such_package")
    assert (missing.ok, missing.found) == (False, "not installed")
    assert missing.hint == "run: pip install no-such-package"
    broken = doctor.check_package("numpy", "no_such_module")
    assert not broken.ok
    assert "ModuleNotFoundError" in broken.found
    assert broken.hint
    library = doctor.check_library("libnothing.so.9", "libnothing9")
    assert (library.ok, library.hint) == (False, "run: apt-get install libnothing9")
    lacks = "OSError: libGL.so.1: cannot open shared object file"
    monkeypatch.setattr(doctor, "run_python", lambda _: (False, lacks))
    assert doctor.check_package("numpy", "numpy").hint == "run: apt-get install libgl1"


def test_a_process_that_crashes_or_never_ends_is_reported(monkeypatch):
    done, found = doctor.run_python("import os; os.abort()")
    assert (done, found) == (False, "crashed with signal 6")

    def late(*_: Any, **__: Any) -> None:
        raise subprocess.TimeoutExpired("python", 1)

    monkeypatch.setattr(subprocess, "run", late)
    done, found = doctor.run_python("pass")
    assert not done
    assert "no answer" in found


@pytest.mark.parametrize(
    ("name", "value", "hint"),
    [
        ("RECON_DATA", "nowhere", "set RECON_DATA to a folder"),
        ("kiss_icp_mapping", "{}", "unset kiss_icp_mapping"),
        ("NUMBA_DISABLE_JIT", "1", "unset NUMBA_DISABLE_JIT"),
    ],
)
def test_variables_that_change_results_or_lead_nowhere_are_reported(monkeypatch, name, value, hint):
    def hints() -> str:
        quick = (check for check in check_kernels() if not check.needed)
        checks = [*doctor.check_environment(), *itertools.islice(quick, 2)]
        return "".join(check.hint for check in checks)

    monkeypatch.delenv(name, raising=False)
    assert not hints()
    monkeypatch.setenv(name, value)
    assert hint in hints()


def test_a_folder_below_a_file_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    below = tmp_path / "file" / "outputs"
    assert not doctor.check_folder("x", below, "use --out", needed=True).ok
    assert doctor.check_folder("x", tmp_path / "a" / "b", "", needed=True).ok
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def test_table_names_what_is_missing_and_says_ready_where_only_niceties_lack():
    gone = Check("a [1]", ok=False, found="gone", hint="run: x")
    for check, line in ((gone, "missing"), (replace(gone, needed=False), "note")):
        stream = io.StringIO()
        print_checks([check, Check("b", True, "2")], Console(file=stream, width=100))
        assert f"{line} a [1]: run: x" in stream.getvalue()
        assert ("ready" in stream.getvalue()) is not check.needed


NOT_IN_CACHE = """
import importlib, pkgutil
from pathlib import Path
from numba.core.dispatcher import Dispatcher
import recon

for module in pkgutil.walk_packages(recon.__path__, "recon."):
    if ".kernels." not in module.name:
        continue
    for name, kernel in vars(importlib.import_module(module.name)).items():
        if isinstance(kernel, Dispatcher) and kernel.targetoptions.get("inline") != "always":
            if not Path(kernel._cache._cache_file._index_path).exists():
                print(f"{module.name}.{name}")
"""

FIRST_RUN = """
import sys
from pathlib import Path
from recon.cli import app
from recon.io.images.image import write_image
from recon.core.kernels.cache import when_compiling
from recon.sources.synthetic import SyntheticSource
from tests.scenery.kitti import write_kitti
from recon.street.settings import StreetSettings

drive, compiled = Path(sys.argv[1]), []
street = SyntheticSource(StreetSettings(frames=4, width_px=256, height_px=96, focal_px=150.0))
write_kitti(street, drive / "drive")
pair = next(iter(street))
for side in ("left", "right"):
    write_image(drive / f"{side}.png", getattr(pair, side))
    write_image(drive / f"{side}_grey.png", getattr(pair, side)[:, :, 1])
calib = ["--calib", str(drive / "drive" / "calib.txt")]
with when_compiling(compiled.append):
    for matcher in ("sad", "sgm"):
        chosen = ["--matcher", matcher, "--quiet", "--out"]
        for kind in ("", "_grey"):
            images = [str(drive / f"{side}{kind}.png") for side in ("left", "right")]
            app(["pair", *images, *calib, *chosen, str(drive / f"pair{kind}_{matcher}")],
                standalone_mode=False)
        out = str(drive / f"map_{matcher}")
        app(["map", str(drive / "drive"), *chosen, out, "--no-mesh"], standalone_mode=False)
print("compiled:", *compiled)
"""


def printed(code: str, environment: dict[str, str], *arguments: str) -> list[str]:
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow
@pytest.mark.timeout(3600)  # two minutes of a core of its own; others may have most of it
@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="kernels are not compiled")
def test_every_kernel_is_compiled_and_no_command_of_a_first_run_compiles_more(tmp_path):
    root = str(Path(recon.__file__).parents[1])
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": root}
    command = [sys.executable, "-m", "recon", "doctor", "--compile", "--json"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["kernels"] > 0
    assert printed(NOT_IN_CACHE, environment) == []
    assert printed(FIRST_RUN, environment, str(tmp_path))[-1] == "compiled:"
