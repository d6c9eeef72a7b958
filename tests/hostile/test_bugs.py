"""A bug of ours is one line, a file with the traceback, and exit code 3."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from recon.io.files import reading
from recon.stereo.match import registry
from tests.hostile.refusals import Ended, assert_refused, run


@pytest.fixture(autouse=True)
def _scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))


def _break_the_matcher(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    class Broken:
        def match(self, pair: object) -> None:
            raise error

    monkeypatch.setitem(registry.MATCHERS, "sad", lambda *_: Broken())


@pytest.mark.parametrize(
    "error",
    [
        ValueError("two\nlines"),
        KeyError("x"),
        TypeError("bad"),
        RecursionError("deep"),
        ModuleNotFoundError("No module named 'recon.nothing'", name="recon.nothing"),
        ImportError("cannot import name 'nothing' from 'recon'", name="recon"),
    ],
)
def test_a_bug_in_matching_is_no_fault_of_the_file(
    pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    _break_the_matcher(monkeypatch, error)
    ended = run("disparity", *pair, "--quiet", "--out", "out")
    assert ended.code == 3
    assert ended.out == ""
    (line,) = ended.lines
    found = re.fullmatch(r"error: internal error \((.*)\), please report: (\S+)", line)
    assert found is not None, line
    assert found[1].startswith(type(error).__name__)
    told = Path(found[2]).read_text()
    assert "Traceback" in told
    assert "in match" in told
    assert not Path("out").exists()


def test_a_bug_is_reported_without_a_folder_for_temporary_files(
    pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    _break_the_matcher(monkeypatch, ValueError("bad"))
    monkeypatch.setattr(tempfile, "tempdir", "/nonexistent")
    ended = run("disparity", *pair, "--quiet", "--out", "out")
    assert ended.code == 3
    assert len(ended.lines) == 1
    assert "TMPDIR" in ended.lines[0]


@pytest.mark.parametrize(
    "error",
    [
        ModuleNotFoundError("No module named 'cv2'", name="cv2"),
        ImportError("libGL.so.1: cannot open shared object file"),
        ImportError("cannot import name 'x' from 'reconnect'", name="reconnect"),
    ],
)
def test_a_package_that_cannot_be_imported_is_no_bug(
    pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    _break_the_matcher(monkeypatch, error)
    ended = run("disparity", *pair, "--quiet", "--out", "out")
    assert_refused(ended, str(error), "recon doctor")
    assert not Path("out").exists()


@pytest.mark.parametrize(
    ("package", "command"),
    [
        ("cv2", "pair a b"),
        ("numba", "map drive"),
        ("open3d", "mesh cloud.ply"),
        ("rich", "settings"),
        ("typer", "--help"),
    ],
)
def test_a_command_names_the_package_that_it_lacks(package: str, command: str, here: Path) -> None:
    lacking = (
        f"import sys; sys.modules[{package!r}] = None; from recon.__main__ import main; "
        f"sys.argv = ['recon', *{command.split()!r}]; main()"
    )
    (here / "drive").mkdir()
    done = subprocess.run([sys.executable, "-c", lacking], capture_output=True, check=False)
    assert_refused(Ended(done.returncode, done.stdout.decode(), done.stderr.decode()), package)


def test_a_missing_package_is_no_fault_of_the_file_that_is_read(here: Path) -> None:
    with pytest.raises(ModuleNotFoundError), reading(here / "file"):
        raise ModuleNotFoundError("No module named 'cv2'", name="cv2")
