"""Machine code of kernels is never older than their sources."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import pytest

from recon.kernels import cache, voxels
from recon.kernels.cache import cache_folder, cache_parent
from recon.kernels.compiled import kernel

compiled = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="kernels are not compiled")


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    folder = tmp_path / "sources"
    folder.mkdir()
    (folder / "outer.py").write_text("from inner import f\n")
    (folder / "inner.py").write_text("def f(): return 1\n")
    return folder


def test_a_change_in_any_source_gives_another_folder(tmp_path: Path, sources: Path) -> None:
    before = cache_folder(tmp_path, sources)
    assert cache_folder(tmp_path, sources) == before
    (sources / "inner.py").write_text("def f(): return 2\n")
    assert cache_folder(tmp_path, sources) != before


def test_folders_of_earlier_sources_are_removed(tmp_path: Path, sources: Path) -> None:
    current = cache_folder(tmp_path, sources)
    current.mkdir()
    earlier, other = tmp_path / "kernels-0123", tmp_path / "notes"
    for folder in (earlier, other):
        folder.mkdir()
        (folder / "file").write_text("")
    cache_folder(tmp_path, sources)
    assert earlier.is_dir()  # nothing is tidied while the current one is in use
    current.rmdir()
    cache_folder(tmp_path, sources)
    assert not earlier.exists()
    assert other.is_dir()


def test_the_cache_is_where_numba_is_told_to_keep_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert cache_parent() == tmp_path


def test_the_cache_is_the_users_where_the_installation_cannot_be_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache.os, "access", lambda *_: False)
    assert cache_parent() == tmp_path / "recon"


@compiled
def test_kernels_are_cached_in_the_folder_of_their_sources() -> None:
    kept = Path(voxels.pack_key.stats.cache_path)
    assert kept.parent == cache_folder(cache_parent())


@compiled
def test_other_users_of_numba_keep_their_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", "elsewhere")

    def double(value: int) -> int:
        return 2 * value

    assert kernel(double)(np.int64(4)) == 8
    assert numba.config.CACHE_DIR == "elsewhere"
