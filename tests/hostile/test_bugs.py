"""A bug of ours is one line, a file with the traceback, and exit code 3."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import pytest

from recon.stereo.match import registry
from tests.hostile.refusals import run


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
    "error", [ValueError("two\nlines"), KeyError("x"), TypeError("bad"), RecursionError("deep")]
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
