from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import recon
from recon.cli.show.tables import print_checks
from recon.commands.doctor import check_kernels, examine
from recon.run import installation
from recon.run.installation import Check


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
    checks = list(check_kernels())
    assert {"kernels of map", "kernels of stereo"} <= {check.name for check in checks}
    for check in checks:
        assert not check.ok
        assert check.needed
        assert check.found == "ImportError: half of it is gone"


def test_failed_checks_say_what_to_do() -> None:
    missing = installation.check_package("no-such-package", "no_such_package")
    assert not missing.ok
    assert missing.found == "not installed"
    assert missing.hint == "run: pip install no-such-package"


def test_a_package_that_cannot_be_imported_is_reported_with_its_last_line() -> None:
    broken = installation.check_package("numpy", "no_such_module")
    assert not broken.ok
    assert "ModuleNotFoundError" in broken.found
    assert broken.hint


def test_a_missing_system_library_names_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: str) -> tuple[bool, str]:
        return False, "OSError: libGL.so.1: cannot open shared object file"

    monkeypatch.setattr(installation, "run_python", fail)
    assert installation.check_package("numpy", "numpy").hint == "run: apt-get install libgl1"


@pytest.mark.skipif(sys.platform != "linux", reason="libraries are looked for on Linux alone")
def test_system_libraries_are_looked_for() -> None:
    (check,) = installation.check_system_libraries({"libnothing.so.9": "libnothing9"})
    assert not check.ok
    assert check.hint == "run: apt-get install libnothing9"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signals of this kind")
def test_a_package_that_crashes_the_process_is_reported() -> None:
    done, told = installation.run_python("import os; os.abort()")
    assert not done
    assert told.startswith("crashed with signal")


def test_an_import_that_never_ends_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def late(*_: Any, **__: Any) -> None:
        raise subprocess.TimeoutExpired("python", 1)

    monkeypatch.setattr(subprocess, "run", late)
    done, told = installation.run_python("pass")
    assert not done
    assert "no answer" in told


def test_real_data_may_be_missing_but_not_wrong(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("RECON_DATA", raising=False)
    assert installation.check_data().ok
    monkeypatch.setenv("RECON_DATA", str(tmp_path))
    assert installation.check_data().ok
    monkeypatch.setenv("RECON_DATA", str(tmp_path / "nowhere"))
    assert not installation.check_data().ok


def test_variables_that_change_kiss_icp_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("kiss_icp_mapping", "{}")
    check = installation.check_kiss_icp_environment()
    assert not check.ok
    assert "unset kiss_icp_mapping" in check.hint


def test_kernels_that_are_not_compiled_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert not next(iter(installation.check_numba())).ok
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "0")
    assert next(iter(installation.check_numba())).ok


def test_a_folder_below_a_file_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    below = tmp_path / "file" / "outputs"
    assert not installation.check_folder("x", below, needed=True, hint="use --out").ok
    assert installation.check_folder("x", tmp_path / "a" / "b", needed=True, hint="").ok
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def table(checks: list[Check]) -> str:
    stream = io.StringIO()
    print_checks(checks, Console(file=stream, width=100))
    return stream.getvalue()


def test_table_names_what_is_missing_and_what_to_do() -> None:
    shown = table([Check("a [1]", ok=False, found="gone", hint="run: x"), Check("b", True, "2")])
    assert "missing a [1]: run: x" in shown
    assert "ready" not in shown


def test_table_says_ready_where_only_niceties_lack() -> None:
    shown = table([Check("a", ok=False, found="gone", hint="run: x", needed=False)])
    assert "note a: run: x" in shown
    assert "ready" in shown
