"""Small files that claim very much: refused before memory is taken for what they claim."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from recon.core.values import RectifiedCamera
from recon.io.models.octomap import read_octomap
from recon.map.map import Map
from recon.map.store.records import Store
from tests.hostile.refusals import refusal

MOST_BYTES: Final = 64_000_000
"""Much more than the files of these tests, and much less than they claim."""


@contextmanager
def little_memory() -> Iterator[None]:
    """Fail where numpy and Python take more memory than a small file needs."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < MOST_BYTES, f"{peak / 1e6:.0f} MB"


def read_all(path: Path) -> None:
    """Read every record of a map as commands do."""
    with Map.open(path) as map_:
        assert map_.links is not None
        for session in map_.sessions:
            assert session.camera.width_px
            assert session.loops is not None
            assert session.fixes is not None
            session.state()
            for frame in range(session.ray_frames):
                session.rays(frame)
            list(session.submaps)
            list(session.keyframes)


def changed(path: Path, kind: str, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Change the first record of a kind, or make one, in a map that stays a valid file."""
    with Store.open(path) as store:
        keys = store.keys(kind)
        key = keys[0] if keys else 0
        content = store.read(kind, key, most_bytes=1 << 40) if keys else {}
        store.put(kind, key, change(content), compress=True)
        store.commit()


KINDS: Final = (
    "session", "axes", "frames", "rays", "keyframe", "loops", "links", "submap", "submap_entry",
    "state",
)  # fmt: skip


@pytest.fixture
def map_file(finished: Path) -> Path:
    return finished / "map" / "map.recon"


def test_the_map_of_a_run_takes_little_memory(map_file: Path) -> None:
    with little_memory():
        assert refusal(lambda: read_all(map_file)) is None


@pytest.mark.parametrize("kind", KINDS)
def test_a_record_with_arrays_of_deflated_zeros_is_refused(kind: str, map_file: Path) -> None:
    zeros = {f"zeros{number}": np.zeros(5_000_000) for number in range(3)}
    changed(map_file, kind, lambda content: {**content, "claimed": zeros})
    assert map_file.stat().st_size < 10_000_000
    with little_memory():
        line = refusal(lambda: read_all(map_file))
    assert line is not None
    assert "claims more than it can hold" in line
    assert str(map_file) in line


def many(rows: int) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Make every array of a tree, and of those in it, as long; all zeros."""

    def longer(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return np.zeros((rows, *value.shape[1:]), value.dtype)
        if isinstance(value, dict):
            return {name: longer(item) for name, item in value.items()}
        return value

    return longer


ROWS: Final = {"frames": 10**6, "rays": 10**7, "keyframe": 2 * 10**6, "submap": 2 * 10**6}


@pytest.mark.parametrize("kind", ROWS)
@pytest.mark.parametrize("neighbours", ["true", "forged"])
def test_a_record_of_very_many_rows_is_refused(kind: str, neighbours: str, map_file: Path) -> None:
    changed(map_file, kind, many(ROWS[kind]))
    if neighbours == "forged":
        if kind != "keyframe":  # before which a forged entry is noticed
            forged = {"voxels": 10**9, "cells": 10**9}
            changed(map_file, "submap_entry", lambda entry: {**entry, **forged})
        camera = RectifiedCamera(1e5, 5e4, 5e4, 5e4, 0.5, 100_000, 100_000).__dict__
        changed(map_file, "axes", lambda axes: {**axes, "camera": camera})
    with little_memory():
        line = refusal(lambda: read_all(map_file))
    assert line is not None
    assert "claims more than it can hold" in line


def test_an_octomap_of_few_nodes_that_cover_very_many_cells_is_refused(here: Path) -> None:
    """Eight levels of one child each, then eight leaves of 256 cells along each side."""
    inner = struct.pack("<fB", 0.5, 1) * 7 + struct.pack("<fB", 0.5, 255)
    nodes = inner + struct.pack("<fB", 0.5, 0) * 8
    header = f"# Octomap OcTree file\nid OcTree\nsize {len(nodes) // 5}\nres 0.1\ndata\n"
    Path("claims.ot").write_bytes(header.encode() + nodes)
    with little_memory():
        line = refusal(lambda: read_octomap("claims.ot"))
    assert line is not None
    assert line.startswith("claims.ot: the OctoMap claims far more cells than it has nodes")
