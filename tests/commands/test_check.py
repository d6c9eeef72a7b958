"""A map is whole or its damage is named, whatever happened to the file."""

import json
import os
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from recon.cli import app
from recon.commands.check import check_map
from recon.core.errors import ReconError
from recon.core.progress import Progress, showing
from recon.map.map import Map
from recon.map.store.records import Store
from recon.map.store.trees import FRAMES, RAYS

GOLDEN = Path(__file__).parents[1] / "map/store/format_2.recon"


@pytest.fixture
def golden(tmp_path):
    return Path(shutil.copy(GOLDEN, tmp_path / "map.recon"))


def check(path, *words):
    return CliRunner().invoke(app, ["map", "--check", str(path), *words])


def _records(path):
    with sqlite3.connect(path) as database:
        return database.execute("SELECT * FROM record ORDER BY kind, key").fetchall()


def _flip(path, kind, key, place):
    """Flip a bit of the content of a record."""
    with sqlite3.connect(path) as database:
        of = "FROM record WHERE kind = ? AND key = ?"
        content = bytearray(database.execute(f"SELECT content {of}", (kind, key)).fetchone()[0])
        content[int(place * (len(content) - 1))] ^= 4
        put = "UPDATE record SET content = ? WHERE kind = ? AND key = ?"
        database.execute(put, (bytes(content), kind, key))
    database.close()


RECORDS = [(row[0], row[1]) for row in _records(GOLDEN) if row[4]]


def test_what_is_in_a_map(golden):
    found = check_map(golden)
    with Map.open(golden) as map_:
        assert [one.frames for one in found.sessions] == [len(one) for one in map_.sessions]
        assert found.sessions[0].length_m == map_.first.trajectory.path_length_m
        assert found.links == len(map_.links)
        for number, one in enumerate(map_.sessions):
            kinds = found.records[str(number)]
            assert (kinds["rays"], kinds["keyframe"]) == (len(one), len(one.keyframes.frames))
    assert (found.format, found.newest_format, found.damaged) == (2, 2, {})
    assert found.versions["0"]["recon"] == "1.0.0"
    rows = _records(golden)
    assert sum(sum(one.values()) for one in found.records.values()) == len(rows)
    size = sum(sum(one.values()) for one in found.bytes.values())
    assert size == sum(len(row[2]) + len(row[4]) for row in rows)


def test_the_terminal_has_eight_lines_at_most_and_programs_everything(golden):
    with Map.open(golden, read_only=False) as map_:
        info = map_.first.info
        for _ in range(4):
            new = map_.begin(info)
            new.add_frame(np.eye(4), 0.0, map_.first.health[0])
            new.set_axes(np.eye(4), map_.first.camera)
        map_.commit()
    done = check(golden)
    lines = done.stdout.splitlines()
    assert (done.exit_code, len(lines)) == (0, 8)
    assert max(map(len, (line for line in lines if str(golden) not in line))) <= 80
    assert "and 4 sessions more" in done.stdout
    assert len(json.loads(check(golden, "--json").stdout)["sessions"]) == 6


@settings(max_examples=80, deadline=None)
@given(record=st.sampled_from(RECORDS), place=st.floats(0, 1))
def test_every_flipped_byte_of_a_record_is_found_and_named(record, place, tmp_path_factory):
    path = Path(shutil.copy(GOLDEN, tmp_path_factory.mktemp("flipped") / "map.recon"))
    _flip(path, *record, place)
    ((damaged, why),) = check_map(path).damaged.items()
    assert why == "a record of the map is damaged"
    session, _, number = record[1].partition(",")
    if record[0] != "links":
        assert f"of session {session}" in damaged
        assert damaged.endswith(number)


@settings(max_examples=60, deadline=None)
@given(place=st.floats(0, 1), bit=st.integers(0, 7))
def test_a_flipped_byte_anywhere_is_found_or_changes_nothing(place, bit, tmp_path_factory):
    path = tmp_path_factory.mktemp("flipped") / "map.recon"
    content = bytearray(GOLDEN.read_bytes())
    content[int(place * (len(content) - 1))] ^= 1 << bit
    path.write_bytes(content)
    try:
        damaged = check_map(path).damaged
    except ReconError:
        return
    assert damaged or _records(path) == _records(GOLDEN)


@pytest.mark.parametrize("tenth", range(10))
def test_a_truncated_file_is_one_line(golden, tenth):
    os.truncate(golden, golden.stat().st_size * tenth // 10 + 7 * (tenth > 0))
    done = check(golden)
    assert (done.exit_code, done.stdout, done.stderr.count("\n")) == (1, "", 1)
    assert str(golden) in done.stderr


def test_the_first_damage_is_named_and_the_others_are_counted(golden):
    for key in ("0,4", "1,2"):
        _flip(golden, RAYS, key, 0.5)
    _flip(golden, FRAMES, "0,0", 0.5)
    done = check(golden)
    assert done.exit_code == 1
    assert done.stderr.startswith(f"error: {golden}: a record of the map is damaged (got frames of")
    assert done.stderr.endswith("; 2 other records cannot be read\n")
    done = check(golden, "--json")
    first, *others = json.loads(done.stdout)["damaged"]
    assert first == "frames of session 0, number 0"
    assert others == ["rays of session 0, number 4", "rays of session 1, number 2"]
    assert done.exit_code == 1


def test_what_is_whole_but_no_drive_is_found(golden):
    with Store.open(golden) as store:
        store.put(RAYS, (0, 2), {"steps": np.zeros((2, 3))})
        store.put("view", (0, 77), {"keyframe": {}})
        store.commit()
    ((damaged, why),) = check_map(golden).damaged.items()
    assert damaged == "file"
    assert "keyframes of frames without a pose" in why
    with Store.open(golden) as store:
        store.delete("view", (0, 77))
        store.commit()
    (damaged,) = check_map(golden).damaged
    assert damaged == "file"


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: None, "file does not exist"),
        (lambda path: path.mkdir(), "folder has no map"),
        (lambda path: path.write_bytes(b""), "not a map of recon"),
        (lambda path: path.write_bytes(b"no database" * 99), "not a map of recon"),
        (lambda path: sqlite3.connect(path).execute("CREATE TABLE a (b)"), "not a map of recon"),
        (os.mkfifo, "not a regular file"),
    ],
)
def test_what_is_no_map_is_one_line(tmp_path, make, said):
    make(tmp_path / "map.recon")
    done = check(tmp_path / "map.recon")
    assert (done.exit_code, done.stdout, done.stderr.count("\n")) == (1, "", 1)
    assert said in done.stderr


def test_a_newer_format_is_one_line(golden):
    with sqlite3.connect(golden) as database:
        database.execute("PRAGMA user_version = 99")
    database.close()
    assert "a newer version of recon (got format 99" in check(golden).stderr


def test_a_map_that_is_being_written_is_read_as_it_was_committed(golden):
    with Map.open(golden, read_only=False) as map_:
        map_.begin(map_.first.info)
        assert len(check_map(golden).versions) == 2
        map_.commit()
        assert len(check_map(golden).versions) == 3
    database = sqlite3.connect(golden, isolation_level=None)
    database.execute("BEGIN EXCLUSIVE")
    done = check(golden)
    database.close()
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
    assert "another process is opening the map" in done.stderr


def test_it_writes_nothing_and_says_how_far_it_is(golden):
    golden.chmod(0o444)
    golden.parent.chmod(0o555)
    before, said = golden.read_bytes(), []

    class Told(Progress):
        def on_start(self, name, total, unit="frames"):
            said.append((name, total))

    with showing(Told()):
        check_map(golden)
    golden.parent.chmod(0o755)
    assert said[0] == ("check the records", len(_records(golden)))
    assert (golden.read_bytes(), [*golden.parent.iterdir()]) == (before, [golden])


@pytest.mark.parametrize("words", [["drive"], ["--out", "x"], ["--set", "scene.scale=1"]])
def test_it_is_asked_for_alone(golden, words):
    done = check(golden, *words)
    assert done.exit_code == 2
    assert "give it alone" in done.stderr
