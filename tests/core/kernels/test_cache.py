"""Machine code of kernels is never older than their sources."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numba
import numpy as np
import pytest

import recon
from recon.core.kernels import voxels
from recon.core.kernels.cache import cache_folder, cache_parent, when_compiling
from recon.core.kernels.compiled import kernel
from tests.scenery.patience import LONG_S

compiled = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="kernels are not compiled")


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    folder = tmp_path / "sources" / "room" / "kernels"
    folder.mkdir(parents=True)
    (folder / "outer.py").write_text("from inner import f\n")
    (folder / "inner.py").write_text("def f(): return 1\n")
    return folder


def test_a_change_in_any_source_gives_another_folder(tmp_path: Path, sources: Path) -> None:
    before = cache_folder(tmp_path, sources.parents[1])
    assert cache_folder(tmp_path, sources.parents[1]) == before
    (sources / "inner.py").write_text("def f(): return 2\n")
    assert cache_folder(tmp_path, sources.parents[1]) != before


def test_a_change_in_a_folder_of_kernels_gives_another_folder(
    tmp_path: Path, sources: Path
) -> None:
    (sources / "simd").mkdir()
    (sources / "simd" / "vectors.py").write_text("LANES = 32\n")
    before = cache_folder(tmp_path, sources.parents[1])
    (sources / "simd" / "vectors.py").write_text("LANES = 16\n")
    assert cache_folder(tmp_path, sources.parents[1]) != before


def test_folders_of_earlier_sources_are_removed(tmp_path: Path, sources: Path) -> None:
    current = cache_folder(tmp_path, sources.parents[1])
    current.mkdir()
    earlier, other = tmp_path / "kernels-0123", tmp_path / "notes"
    for folder in (earlier, other):
        folder.mkdir()
        (folder / "file").write_text("")
    cache_folder(tmp_path, sources.parents[1])
    assert earlier.is_dir()  # nothing is tidied while the current one is in use
    current.rmdir()
    cache_folder(tmp_path, sources.parents[1])
    assert not earlier.exists()
    assert other.is_dir()


def test_the_cache_is_where_numba_is_reported_to_keep_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert cache_parent() == tmp_path


@pytest.fixture
def foreign(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The folder of a user who may write nothing but what lies in it."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(os, "access", lambda path, _: tmp_path in (path, *path.parents))
    return tmp_path


def test_the_cache_is_the_users_where_the_installation_cannot_be_written(
    monkeypatch: pytest.MonkeyPatch, foreign: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(foreign / "caches"))
    assert cache_parent() == foreign / "caches" / "recon"


@pytest.mark.parametrize("home", ["/", "~"])
def test_a_user_without_a_home_gets_a_temporary_folder_that_nobody_else_can_write(
    monkeypatch: pytest.MonkeyPatch, foreign: Path, home: str
) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", home)
    monkeypatch.setattr(tempfile, "tempdir", str(foreign))
    kept = cache_parent()
    assert kept.parent == foreign
    assert kept.stat().st_mode & 0o077 == 0
    assert cache_parent() == kept  # the next process finds it again
    kept.chmod(0o777)
    assert cache_parent() not in (kept, Path())
    assert cache_parent().stat().st_mode & 0o077 == 0


@compiled
def test_kernels_are_cached_in_the_folder_of_their_sources() -> None:
    kept = Path(voxels.pack_key.stats.cache_path)
    assert kept.parent == cache_folder(cache_parent())


RACE = """
import sys, time
from pathlib import Path
from numba.core.caching import IndexDataCacheFile
from race_kernel import double

meeting, (mine, other, value) = Path(sys.argv[1]), sys.argv[2:]

def wait(name, seconds=3):
    until = time.monotonic() + seconds
    while not (meeting / name).exists() and time.monotonic() < until:
        time.sleep(0.01)

load, save = IndexDataCacheFile._load_index, IndexDataCacheFile._save_data
save_index = IndexDataCacheFile._save_index

def load_and_meet(self):
    index = load(self)
    if compiling:
        (meeting / f"{mine} has read").touch()
        wait(f"{other} has read")
    return index

def save_index_in_turn(self, overloads):
    if mine == "second":
        wait("first has an index")
    save_index(self, overloads)
    (meeting / f"{mine} has an index").touch()

def save_in_turn(self, name, data):
    if mine == "first":
        wait("second has written")
    save(self, name, data)
    (meeting / f"{mine} has written").touch()

compiling = []
IndexDataCacheFile._load_index, IndexDataCacheFile._save_data = load_and_meet, save_in_turn
IndexDataCacheFile._save_index = save_index_in_turn
from recon.core.kernels.cache import when_compiling
(meeting / f"{mine} is ready").touch()
wait(f"{other} is ready", 60)
with when_compiling(compiling.append):
    assert double(eval(value)) == 2 * eval(value)
"""


@compiled
@pytest.mark.slow
def test_processes_that_compile_for_different_types_do_not_mix_up_their_code(
    tmp_path: Path,
) -> None:
    """The second writes the index last and the first the code: what numba alone would mix up."""
    (tmp_path / "race_kernel.py").write_text(
        "from recon.core.kernels.compiled import kernel\n\n"
        "@kernel\ndef double(x):\n    return 2 * x\n"
    )
    (tmp_path / "race.py").write_text(RACE)
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path(recon.__file__).parents[1])]),
    }
    both = [
        subprocess.Popen(
            [sys.executable, str(tmp_path / "race.py"), str(tmp_path), *arguments], env=environment
        )
        for arguments in (("first", "second", "3"), ("second", "first", "2.5"))
    ]
    assert [process.wait(LONG_S) for process in both] == [0, 0]
    check = "from race_kernel import double; print(double(3), double(2.5))"
    found = subprocess.run(
        [sys.executable, "-c", check], env=environment, capture_output=True, text=True, check=True
    )
    assert found.stdout.split() == ["6", "5.0"]


@compiled
def test_what_is_compiled_is_announced_and_what_is_cached_is_not() -> None:
    def treble(value: int) -> int:
        return 3 * value

    announced: list[str] = []
    function = kernel(treble)
    with when_compiling(announced.append):
        assert function(np.int32(1)) == 3
        assert function(np.int32(2)) == 6
        first = tuple(announced)
        assert kernel(treble)(np.int32(3)) == 9
    kernel(treble)(np.complex64(1))
    assert first in (("treble",), ())  # cached by an earlier run of this test
    assert tuple(announced) == first


@compiled
def test_other_users_of_numba_keep_their_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", "elsewhere")

    def double(value: int) -> int:
        return 2 * value

    assert kernel(double)(np.int64(4)) == 8
    assert numba.config.CACHE_DIR == "elsewhere"
