from __future__ import annotations

import io
import itertools
import os
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import recon
from recon.cli.tables import print_checks
from recon.commands import doctor
from recon.commands.doctor import Check, check_kernels, examine


def test_this_machine_is_examined_and_ready(tmp_path: Path) -> None:
    checks = examine(tmp_path / "outputs")
    assert [check for check in checks if check.needed and not check.ok] == []
    names = {check.name for check in checks}
    assert {"Python", "numpy", "open3d", "kernels of map", "memory", "cores"} <= names
    assert not (tmp_path / "outputs").exists()


def test_what_kernels_lack_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "llvmlite.py").write_text("raise ImportError('half of it is gone')")
    paths = os.pathsep.join([str(tmp_path), str(Path(recon.__file__).parents[1])])
    monkeypatch.setenv("PYTHONPATH", paths)
    checks = [check for check in check_kernels() if check.needed]
    assert {"kernels of map", "kernels of stereo"} <= {check.name for check in checks}
    for check in checks:
        assert not check.ok
        assert check.found == "ImportError: half of it is gone"


def test_what_is_missing_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_a_process_that_crashes_or_never_ends_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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
def test_variables_that_change_results_or_lead_nowhere_are_reported(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, hint: str
) -> None:
    def hints() -> str:
        quick = (check for check in check_kernels() if not check.needed)
        checks = [*doctor.check_environment(), *itertools.islice(quick, 2)]
        return "".join(check.hint for check in checks)

    monkeypatch.delenv(name, raising=False)
    assert not hints()
    monkeypatch.setenv(name, value)
    assert hint in hints()


def test_a_folder_below_a_file_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    below = tmp_path / "file" / "outputs"
    assert not doctor.check_folder("x", below, "use --out", needed=True).ok
    assert doctor.check_folder("x", tmp_path / "a" / "b", "", needed=True).ok
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def test_table_names_what_is_missing_and_says_ready_where_only_niceties_lack() -> None:
    gone = Check("a [1]", ok=False, found="gone", hint="run: x")
    for check, line in ((gone, "missing"), (replace(gone, needed=False), "note")):
        stream = io.StringIO()
        print_checks([check, Check("b", True, "2")], Console(file=stream, width=100))
        assert f"{line} a [1]: run: x" in stream.getvalue()
        assert ("ready" in stream.getvalue()) is not check.needed
