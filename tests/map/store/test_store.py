"""The store of a map: equal to a dictionary, whole after a kill, clear about bad files."""

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra import numpy as some

from recon.core.errors import FormatError, OutputError, ReconError
from recon.map.store import records
from recon.map.store.records import Cache, Store

KINDS = ("rays", "submap")
TYPES = ("<f4", "<f8", "<i2", "<i8", "u1", "?", "<f2", ">f4")
ARRAYS = st.sampled_from(TYPES).flatmap(
    lambda dtype: some.arrays(
        dtype, some.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=9)
    )
)
PLAIN = st.none() | st.booleans() | st.integers(-(2**60), 2**60) | st.floats() | st.text(max_size=5)
TREES = st.dictionaries(
    st.text(max_size=5),
    st.recursive(
        ARRAYS | PLAIN,
        lambda inner: (
            st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
        ),
        max_leaves=5,
    ),
    max_size=4,
)
KEYS = st.integers(-3, 3) | st.tuples(st.integers(-2, 2), st.integers(-20, 20))
KIND = st.sampled_from(KINDS)
STEPS = st.lists(
    st.tuples(st.just("put"), KIND, KEYS, st.integers(0, 99), st.booleans())
    | st.tuples(st.sampled_from(["delete", "read"]), KIND, KEYS)
    | st.tuples(st.sampled_from(["commit", "kill"])),
    max_size=25,
)


def _record(seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return {"seed": seed, "values": rng.normal(size=(seed, 3)), "none": None}


def _plain(value: Any) -> Any:
    """The value to the last bit, to be compared; the order of bytes in arrays does not count."""
    if isinstance(value, np.ndarray):
        native = value.astype(value.dtype.newbyteorder("="))
        return native.dtype.str, native.shape, native.tobytes()
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    return [*map(_plain, value)] if isinstance(value, list) else repr(value)


def _same(one: Any, other: Any) -> bool:
    return bool(_plain(one) == _plain(other))


def _reopened(path: Path) -> Store:
    """The store as another process finds it after a kill: a copy of all files, opened."""
    copy = path.parent / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(path.parent, copy, ignore=lambda *_: ["copy"])
    return Store.open(copy / path.name)


@settings(max_examples=60)
@given(steps=STEPS)
def test_any_sequence_of_changes_commits_and_kills_equals_a_dictionary(steps, tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / "map.recon"
    store, now, kept = Store.create(path, cache_bytes=500), {}, {}
    for what, *args in steps:
        if what == "put":
            kind, key, seed, compress = args
            store.put(kind, key, _record(seed), compress=compress)
            now[kind, key] = seed
        elif what == "delete":
            store.delete(*args)
            now.pop(tuple(args), None)
        elif what == "read" and tuple(args) in now:
            assert _same(store.get(*args), _record(now[tuple(args)]))
        elif what == "commit":
            store.commit()
            kept = dict(now)
        elif what == "kill":
            killed = _reopened(path)
            store.close()
            store, path, now = killed, killed.path, dict(kept)
    for kind in KINDS:
        keys = store.keys(kind)
        assert set(keys) == {key for known, key in now if known == kind}
        ordered = [key if isinstance(key, tuple) else (key,) for key in keys]
        assert ordered == sorted(ordered)
        assert all(_same(store.read(kind, key), _record(now[kind, key])) for key in keys)
    store.close()


@settings(max_examples=100)
@given(tree=TREES, compress=st.booleans())
def test_any_tree_is_read_as_it_was_put(tree, compress):
    with Store.temporary() as store:
        store.put("any", 1, tree, compress=compress)
        assert _same(tree, store.read("any", 1))


def test_large_arrays_shrink_and_keep_their_order_of_axes():
    smooth = np.cumsum(np.ones((5000, 3), np.int16), axis=0, dtype=np.int16)
    turned = np.asfortranarray(np.eye(4))
    with Store.temporary() as store:
        store.put("any", 1, {"smooth": smooth, "turned": turned}, compress=True)
        back = store.read("any", 1, most_bytes=smooth.nbytes)
    assert np.array_equal(back["smooth"], smooth)
    assert back["turned"].flags.f_contiguous
    assert back["smooth"].flags.writeable  # compiled kernels take no others


@pytest.mark.parametrize(
    "value", [{1: 2}, {"a": object()}, {"a": np.array([object()])}, {"a": {1}}]
)
def test_what_no_file_can_hold_is_refused_before_anything_is_written(value):
    with Store.temporary() as store:
        with pytest.raises(TypeError):
            store.put("any", 1, value)
        assert store.keys("any") == []


def test_a_reader_sees_whole_commits_while_another_program_writes(tmp_path):
    path = tmp_path / "map.recon"
    with Store.create(path) as writer:
        writer.put("rays", 0, _record(1))
        writer.commit()
        with pytest.raises(OutputError, match="another process uses the map"):
            Store.open(path)
        with Store.open(path, read_only=True) as reader:
            writer.put("rays", 0, _record(2))
            writer.put("rays", 1, _record(3))
            assert reader.keys("rays") == [0]
            writer.commit()
            assert _same(reader.get("rays", 0), _record(1))
            assert reader.keys("rays") == [0]
        with Store.open(path, read_only=True) as reader:
            assert _same(reader.get("rays", 0), _record(2))
            assert reader.keys("rays") == [0, 1]
            with pytest.raises(OutputError, match=r"can only be read"):
                reader.put("rays", 0, {})
    with Store.open(path, read_only=True):
        assert [p.name for p in tmp_path.iterdir()] == ["map.recon"]


_WRITER = """
import sys
import numpy as np
from pathlib import Path
from recon.map.store.records import Store
store = Store.create(Path(sys.argv[1]))
for number in range(10_000):
    store.put("rays", number, {"values": np.full(20_000, number)})
    store.put("count", 0, {"count": number + 1})
    store.commit()
    print(number, flush=True)
"""


@pytest.mark.parametrize("seen", [0, 3, 9])
def test_a_killed_program_leaves_its_last_commit(tmp_path, seen):
    path = tmp_path / "map.recon"
    program = subprocess.Popen([sys.executable, "-c", _WRITER, str(path)], stdout=subprocess.PIPE)
    while int(program.stdout.readline()) < seen:
        continue
    program.send_signal(signal.SIGKILL)
    program.wait()
    with Store.open(path) as store:
        count = store.get("count", 0)["count"]
        assert store.keys("rays") == list(range(count))
        assert count > seen
        assert all((store.read("rays", key)["values"] == key).all() for key in range(count))


_FULL = """
import resource, sys
import numpy as np
from pathlib import Path
from recon.core.errors import OutputError
from recon.map.store.records import Store
store = Store.create(Path(sys.argv[1]))
store.put("rays", 0, {"values": np.arange(50_000)})
store.commit()
resource.setrlimit(resource.RLIMIT_FSIZE, (1_500_000,) * 2)
try:
    for number in range(1, 10):
        store.put("rays", number, {"values": np.arange(50_000)})
    store.commit()
except OutputError as error:
    print(error)
store.close()
"""


def test_a_full_disk_at_a_commit_leaves_the_one_before(tmp_path):
    path = tmp_path / "map.recon"
    command = [sys.executable, "-c", _FULL, str(path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert str(path) in done.stdout
    assert len(done.stdout.splitlines()) == 1
    with Store.open(path) as store:
        assert store.keys("rays") == [0]
        assert np.array_equal(store.get("rays", 0)["values"], np.arange(50_000))
        store.put("rays", 1, {})
        store.commit()


def _changed(*statements: str) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        Store.create(path).close()
        with sqlite3.connect(path) as database:
            for statement in statements:
                database.execute(statement)
        database.close()

    return make


ENDLESS = """CREATE VIEW record AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id FROM n)
SELECT 'rays' AS kind, id AS key, '' AS tree, 0 AS checksum, '' AS content FROM n"""
FILES = {
    "text": lambda path: path.write_text("rays of a drive\n" * 100),
    "empty": lambda path: path.write_bytes(b""),
    "another program's": _changed("PRAGMA application_id = 1"),
    "format 99": _changed("PRAGMA user_version = 99"),
    "endless": _changed("DROP TABLE record", ENDLESS),
    "folder": Path.mkdir,
    "missing": lambda path: None,
    "pipe": os.mkfifo,
}


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("read_only", [False, True])
def test_files_of_others_are_refused(tmp_path, kind, read_only):
    path = tmp_path / "map.recon"
    FILES[kind](path)
    with pytest.raises(FormatError) as caught:
        Store.open(path, read_only=read_only)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert ("got format 99" in str(caught.value)) == (kind == "format 99")


@pytest.mark.parametrize("end", ["-wal", "-shm", "-journal"])
@pytest.mark.parametrize("read_only", [False, True])
def test_a_pipe_beside_a_map_is_not_waited_for(tmp_path, end, read_only):
    path = tmp_path / "map.recon"
    Store.create(path).close()
    os.mkfifo(path.with_name(path.name + end))
    with pytest.raises(FormatError, match=f"map.recon{end}: not a regular file.*pipe"):
        Store.open(path, read_only=read_only)


@settings(max_examples=60)
@given(place=st.floats(0, 1), bit=st.integers(0, 7), cut=st.booleans())
def test_a_damaged_file_is_refused_or_gives_what_was_put(place, bit, cut, tmp_path_factory):
    path = tmp_path_factory.mktemp("damaged") / "map.recon"
    with Store.create(path) as store:
        for number in range(5):
            store.put("rays", number, _record(90 + number), compress=number % 2 == 0)
        store.commit()
    content = bytearray(path.read_bytes())
    where = int(place * (len(content) - 1))
    content[where] ^= 1 << bit
    path.write_bytes(content[:where] if cut else content)
    try:
        with Store.open(path, read_only=True) as store:
            for key in store.keys("rays"):
                assert isinstance(key, int)
                assert _same(store.read("rays", key), _record(90 + key))
    except ReconError as error:
        assert str(path) in str(error)  # noqa: PT017


@pytest.mark.parametrize("ended", [KeyboardInterrupt, MemoryError])
@pytest.mark.parametrize("copied", [False, True])
def test_a_record_whose_reading_is_cut_short_is_not_called_damaged(ended, copied, monkeypatch):
    def cut(size):
        raise ended

    with Store.temporary() as store, Store.temporary() as other:
        store.put("rays", 0, {"a": np.arange(9)})
        monkeypatch.setattr(records, "bytearray", cut, raising=False)
        with pytest.raises((KeyboardInterrupt, FormatError)) as told:
            store.copy("rays", other) if copied else store.read("rays", 0)
    assert "damaged" not in str(told.value)
    assert isinstance(told.value, KeyboardInterrupt) == (ended is KeyboardInterrupt)


def test_a_missing_record_is_named(tmp_path):
    with Store.create(tmp_path / "map.recon") as store:
        with pytest.raises(FormatError, match=r"lacks a record.*rays 7"):
            store.get("rays", 7)
        store.delete("rays", 7)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write the map"):
        Store.create(tmp_path / "file" / "map.recon")


@given(sizes=st.lists(st.tuples(st.integers(0, 9), st.integers(0, 40)), max_size=40))
def test_the_cache_keeps_its_limit_and_what_was_made(sizes):
    cache, made = Cache(1000), {}
    for key, count in sizes:
        size = made.get(key, count)
        found = cache.get(key, lambda size=size: {"a": np.zeros(size)})
        made[key] = len(found["a"])
        assert len(found["a"]) == size
        assert cache.nbytes <= 1000
    for key in made:
        cache.drop(key)
    assert cache.nbytes == 0


def test_values_used_last_stay_in_the_cache():
    cache, made = Cache(2000), []
    for key in "abaca":
        cache.get(key, lambda key=key: made.append(key) or np.zeros(800, np.uint8))
    assert made == ["a", "b", "c"]
