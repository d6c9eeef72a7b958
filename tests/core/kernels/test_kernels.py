"""Machine code is never older than its sources; the voxel hash agrees with a dictionary."""

import ast
import fcntl
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numba.core.caching import FunctionCache

from recon.core.kernels import cache, voxels
from recon.core.kernels.cache import cache_folder, cache_parent, when_compiling
from recon.core.kernels.compiled import kernel
from recon.core.kernels.voxels import are_among, distinct_keys, find_keys

compiled = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="kernels are not compiled")


@pytest.fixture
def sources(tmp_path):
    """A package in which outer.py calls inner.py, which calls deep.py; other.py calls nobody."""
    folder = tmp_path / "recon" / "room" / "kernels"
    (folder / "simd").mkdir(parents=True)
    for name, text in {
        "outer": "from recon.room.kernels import (\n    inner,\n)\n",
        "inner": "def f():\n    from recon.room.kernels.simd.deep import LANES, g\n",
        "simd/deep": "from recon.room.kernels import inner as around\nLANES = 32\n",
        "other": "LANES = 32\nfrom recon.nowhere import gone\nfrom recon import room\n",
    }.items():
        (folder / f"{name}.py").write_text(text)
    return folder


def folder_of(sources: Path, name: str) -> Path:
    """The folder, as a process finds it that starts now."""
    cache._read.cache_clear()
    cache._imported.cache_clear()
    return cache_folder(sources.parents[2], sources / f"{name}.py", sources.parents[1])


@pytest.mark.parametrize("changed", ["outer", "inner", "simd/deep"])
def test_a_change_gives_other_folders_to_the_file_and_whoever_imports_it_alone(sources, changed):
    before = {name: folder_of(sources, name) for name in ("outer", "inner", "other")}
    assert before == {name: folder_of(sources, name) for name in before}
    path = sources / f"{changed}.py"
    path.write_text(path.read_text() + "LANES = 16\n")
    after = {name: folder_of(sources, name) for name in before}
    assert after["outer"] != before["outer"]
    assert (after["inner"] == before["inner"]) is (changed == "outer")
    assert after["other"] == before["other"]


def test_folders_of_earlier_states_of_a_file_are_removed(sources):
    current, other = folder_of(sources, "outer"), folder_of(sources, "other")
    earlier = current.with_name(f"{current.name[:-4]}0123")
    notes = current.with_name("notes")
    for folder in (current, earlier, other, notes):
        folder.mkdir()
        (folder / "file").write_text("")
    folder_of(sources, "outer")
    assert earlier.is_dir()  # nothing is tidied while the current one is in use
    shutil.rmtree(current)
    folder_of(sources, "outer")
    assert not earlier.exists()
    assert other.is_dir()
    assert notes.is_dir()


def test_imports_of_kernels_are_found_as_python_reads_them():
    """Without reading all of the language, which each command would wait for."""
    root = cache.PACKAGE.parent
    files = [path for path in (root / "recon").rglob("*.py") if "kernels" in path.parts]
    for path in files:
        expected = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module.startswith("recon"):
                place = root.joinpath(*node.module.split("."))
                names = (place / f"{alias.name}.py" for alias in node.names)
                ways = (place.with_suffix(".py"), place / "__init__.py", *names)
                expected |= {way for way in ways if way.is_file()}
        assert set(cache._imported(path, root / "recon")) == expected


@pytest.fixture
def foreign(monkeypatch, tmp_path):
    """The folder of a user who may write nothing but what lies in it."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(os, "access", lambda path, _: tmp_path in (path, *path.parents))
    return tmp_path


def test_the_cache_is_the_users_where_the_installation_cannot_be_written(monkeypatch, foreign):
    monkeypatch.setenv("XDG_CACHE_HOME", str(foreign / "caches"))
    assert cache_parent() == foreign / "caches" / "recon"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(foreign / "numba"))
    assert cache_parent() == foreign / "numba"


@pytest.mark.parametrize("home", ["/", "~"])
def test_a_user_without_a_home_gets_a_temporary_folder_that_nobody_else_can_write(
    monkeypatch, foreign, home
):
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
def test_one_process_at_a_time_writes_the_code_of_a_kernel(monkeypatch):
    """Two that compile for different types would mix up what they write."""
    locked = []

    def save(cache: FunctionCache, *_: object) -> None:
        folder = os.open(cache.cache_path, os.O_RDONLY)
        with pytest.raises(BlockingIOError):
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.close(folder)
        locked.append(cache)

    def double(value: int) -> int:
        return 2 * value

    monkeypatch.setattr(FunctionCache, "save_overload", save)
    assert kernel(double)(np.uint16(3)) == 6
    assert len(locked) == 1


@compiled
@pytest.mark.parametrize("change", ["no place", "other names", "other folder"])
def test_a_numba_that_keeps_code_in_another_way_is_refused(monkeypatch, change):
    """Else code of earlier sources would run, or two would write at a time, and nobody know."""
    dispatcher = type(kernel(lambda value: value))
    begin = dispatcher.__init__

    def begin_otherwise(self: Any, *given: Any, **how: Any) -> None:
        begin(self, *given, **how)
        del self._cache
        if change == "other names":
            self._cache = object()

    if change == "other folder":
        monkeypatch.setattr(FunctionCache, "cache_path", "/elsewhere")
    else:
        monkeypatch.setattr(dispatcher, "__init__", begin_otherwise)
    with pytest.raises(ImportError, match="keeps machine code in another way") as refused:
        kernel(lambda value: value)
    assert refused.value.name == "numba"  # of which the command line says what to do


@compiled
def test_what_is_compiled_is_announced_unless_it_is_cached(monkeypatch):
    assert Path(voxels.pack_key.stats.cache_path).parent == cache_folder(
        cache_parent(), Path(voxels.__file__)
    )
    # Other users of numba keep their cache.
    monkeypatch.setattr(numba.config, "CACHE_DIR", "elsewhere")

    def treble(value: int) -> int:
        return 3 * value

    announced: list[str] = []
    function = kernel(treble)
    assert numba.config.CACHE_DIR == "elsewhere"
    with when_compiling(announced.append):
        assert (function(np.int32(1)), function(np.int32(2))) == (3, 6)
        first = tuple(announced)
        assert kernel(treble)(np.int32(3)) == 9
    kernel(treble)(np.complex64(1))
    assert first in (("treble",), ())  # cached by an earlier run of this test
    assert tuple(announced) == first


def sum_points_reference(frames, edge):
    """Sum frames of points (xyz, weights, values, doublings) up by voxel, as first seen."""
    found: dict[tuple[int, ...], dict[str, Any]] = {}
    for xyz, *columns in frames:
        best: dict[tuple[int, ...], float] = {}
        for point, w, value, by in zip(xyz.astype(np.float64), *columns, strict=True):
            if not w > 0:
                continue
            large, half = 2 ** int(by), 2 ** int(by) // 2
            whole = np.floor(point / edge).astype(int)
            cell = tuple((whole // large * large + half).tolist())
            empty = {"sums": np.zeros(4 + len(value)), "information": 0.0, "frames": 0}
            voxel = found.setdefault(cell, empty)
            offset = point - (np.array(cell) + 0.5) * edge
            voxel["sums"] += w * np.concatenate([[1.0], offset, value])
            best[cell] = max(best.get(cell, 0.0), float(w))
        for cell, weight in best.items():
            found[cell]["information"] += weight
            found[cell]["frames"] += 1
    return found


# float32 sums of n ≤ 240 terms err by n · 2^-24 of the sum of their sizes: 1.4e-5 of the sum where
# all have one sign (values, weights; information takes two operations a term). Offsets from the
# middle of a cell (half of it, times weights up to 5) cancel: 240 · 2^-24 · (240 · 5 / 2) = 8.6e-3;
# of one that is doubled twice, they are four times as long.
SUM_ROUNDING = {"rtol": 3e-5, "atol": 4e-2}
CELLS = st.integers(-voxels.KEY_LIMIT, voxels.KEY_LIMIT - 1)
ANY = st.integers(-(2**62), 2**62) | st.integers(0, 9)
KEYS = hnp.arrays(np.int64, st.integers(0, 30), elements=ANY)


def _random_frame(rng: np.random.Generator, number: int) -> tuple[np.ndarray, ...]:
    xyz = rng.uniform(-3, 3, (number, 3)).astype(np.float32)
    weights = np.where(rng.random(number) < 0.1, 0, rng.uniform(0.1, 5, number))
    values = rng.uniform(-1, 255, (number, 2))
    doublings = rng.integers(0, 3, number).astype(np.uint8)
    return xyz, weights.astype(np.float32), values.astype(np.float32), doublings


def _sum(frames: list[tuple[np.ndarray, ...]], edge: float) -> voxels.VoxelSums:
    sums = voxels.make_sums(1, 2)
    for number, frame in enumerate(frames):
        points = voxels.VoxelPoints(*frame)
        sums = voxels.add_points(sums, points, edge, number)
    return sums


@given(st.lists(st.tuples(*[CELLS] * 3), min_size=1, max_size=20))
def test_unpacking_inverts_packing(cells):
    keys = voxels.pack_keys(np.array(cells))
    assert (keys >= 0).all()
    assert keys.tolist() == [voxels.pack_key(*cell) for cell in cells]
    assert voxels.unpack_keys(keys).tolist() == [list(cell) for cell in cells]


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    sizes=st.lists(st.integers(0, 60), min_size=1, max_size=4),
    edge=st.sampled_from([0.1, 0.5, 1.0, 7.0]),
)
def test_sums_of_frames_and_parts_equal_the_reference(seed, sizes, edge):
    rng = np.random.default_rng(seed)
    frames = [_random_frame(rng, size) for size in sizes]
    expected = sum_points_reference(frames, edge)
    total = voxels.make_sums(1, 2)
    for part in (_sum([frame], edge) for frame in frames):
        n = int(part.used[0])
        total = voxels.add_rows(
            total, part.keys[:n], part.sums[:n], part.information[:n], part.frames[:n]
        )
    for sums in (total, _sum(frames, edge)):
        cells = [tuple(cell) for cell in voxels.unpack_keys(sums.keys[: sums.used[0]]).tolist()]
        assert cells == list(expected)
        for row, cell in enumerate(cells):
            np.testing.assert_allclose(sums.sums[row], expected[cell]["sums"], **SUM_ROUNDING)
            assert sums.information[row] == pytest.approx(expected[cell]["information"], rel=3e-5)
            assert sums.frames[row] == expected[cell]["frames"]


@given(KEYS, KEYS)
def test_keys_are_found_and_distinct_ones_sorted(wanted, keys):
    place, known = find_keys(wanted, np.sort(keys))
    np.testing.assert_array_equal(known, np.isin(wanted, keys))
    np.testing.assert_array_equal(np.sort(keys)[place[known]], wanted[known])
    np.testing.assert_array_equal(are_among(wanted, keys), known)
    np.testing.assert_array_equal(distinct_keys(keys), np.unique(keys))
