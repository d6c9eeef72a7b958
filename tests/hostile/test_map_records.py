"""Records of a map that claim very much, or with a valid checksum and nonsense in any one place."""

import struct
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from recon.core.kernels.voxels import pack_keys
from recon.core.values import RayCloud, RectifiedCamera
from recon.io.models.octomap import read_octomap
from recon.look.fault import NAMES
from recon.look.fit import FittedFault
from recon.look.rig import RefinedRig
from recon.map.builders import OccupancySettings, Submap, ray_grain
from recon.map.fusion import FusedPart, join_fused
from recon.map.kernels.clamped import CellRows
from recon.map.map import Map
from recon.map.occupancy.part import OccupancyPart, SurfacePoints, join_occupancy
from recon.map.store.map_file import MapViews
from recon.map.store.records import Key, Store
from recon.map.store.session import OPTIMISED_POSES, POSES_BEFORE_LINKS, SessionInfo
from recon.map.store.trees import Link
from recon.odometry.protocol import OdometryHealth
from recon.places.detector import StoredKeyframe
from recon.places.keyframe import Keyframe, points_of
from recon.places.places import Loop
from recon.places.pose_graph import Fixes
from recon.stereo.rectify.epipolar import as_raw
from tests.hostile.refusals import refusal

FRAMES: Final = 3
KEYS: Final = pack_keys(np.array([[0, 0, 0], [1, 2, 3]]))
LOOP: Final = Loop(0, 2, np.eye(4), np.eye(6), 30, 0.5)


def write_map(path: Path) -> None:
    """Write two linked drives with one record of every kind, and every field in it."""
    with Map.create(path) as map_:
        for _ in range(2):
            _add_drive(map_)
        map_.set_links([Link((0, 1), LOOP)], [0, 1])
        map_.commit()


def _add_drive(map_: Map) -> None:
    session = map_.begin(SessionInfo("drive", "of a test", FRAMES))
    camera = RectifiedCamera(100.0, 9.0, 5.0, 9.0, 0.5, 20, 12, 8)
    session.set_axes(np.eye(4), camera)
    none = np.zeros(len(NAMES))
    fitted = FittedFault(none, np.eye(len(NAMES)), none, 1.0, 12)
    raw = as_raw(camera)
    lens = replace(raw.left, distortion=np.full(5, 0.01))
    session.set_rig(RefinedRig(camera, replace(raw, left=lens, right=lens), camera, fitted))
    grain, ones = ray_grain(OccupancySettings()), np.ones(4, np.uint8)
    texture = np.ones((2, 3), np.uint8)
    kept = ones.astype(np.float16), ones, ones, grain.unit_m, texture
    rays = RayCloud(np.ones((4, 3), np.int16), *kept)
    for frame in range(FRAMES):
        session.add_frame(np.eye(4), float(frame), OdometryHealth(notes=("note",)))
        session.add_rays(frame, rays, grain)
    uvd, coarse = np.ones((4, 3), np.float32), np.ones((2, 2), np.float32)
    seen = Keyframe(1, uvd, np.ones((4, 32), np.uint8), coarse)
    session.keyframes.put(StoredKeyframe(seen, np.eye(4), 1.0, 0, (LOOP,), ("few inliers",)))
    two = np.ones(2, np.float32)
    fused = FusedPart(KEYS, np.ones((2, 11), np.float32), two, np.ones(2, np.int32))
    starts, cells = np.array([0, 1, 2], np.int64), np.array([0, 511], np.uint16)
    rows = CellRows(KEYS, starts, cells, np.ones((2, 3), np.float32))
    occupancy = OccupancyPart(rows, SurfacePoints(KEYS, np.ones((2, 5), np.float32)))
    session.submaps.add(Submap(0, 0, FRAMES, fused, occupancy))
    path = np.stack([np.eye(4)] * FRAMES)
    session.set_loops(
        {"closed": [asdict(LOOP)], "refused": [], OPTIMISED_POSES: path, POSES_BEFORE_LINKS: path}
    )
    frames, places_m = np.arange(3, dtype=np.int32), np.zeros((3, 3))
    session.set_fixes(Fixes(frames, places_m, places_m, 0.1))


def read_map(path: Path) -> None:
    """Read all that a map keeps of its last drive, and give it to the loops that trust it."""
    with Map.open(path) as map_:
        _ = map_.doubts, map_.links, list(MapViews(map_))
        for session in map_.sessions[-1:]:  # the one whose records are spoiled
            _ = session.camera, session.fixes, session.trajectory, session.corrections()
            _ = session.loops, session.state(), session.rig
            _ = [session.rays(frame)[0].cloud() for frame in range(session.ray_frames)]
            _ = [points_of(stored.keyframe.uvd, session.camera) for stored in session.keyframes]
            join_fused(submap.fused for submap in session.submaps).cloud(0.1, 1)
            join_occupancy(submap.occupancy for submap in session.submaps).voxels(0.1)


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    path = tmp_path_factory.mktemp("records") / "map.recon"
    write_map(path)
    read_map(path)
    with Store.open(path) as store:
        store._database.execute("COMMIT")
        store._database.execute("PRAGMA synchronous = OFF")
        store._database.execute("BEGIN")
        yield store, path


#: What has no type: settings are checked when they are used, and why loops were refused is shown.
FREE: Final = ("config", "versions", "start", "refused")
NOTHING: Final[dict[str, Callable[[Any], Any]]] = {
    "null": lambda value: None,
    "a word": lambda value: "word",
    "a tree": lambda value: {},
    "an array of another type": lambda value: np.zeros((3, 2, 1), np.complex64).view("f2"),
    "a list of null": lambda value: [None],
}
ARRAYS: Final[dict[str, Callable[[Any], Any]]] = {
    "no axis": lambda value: value.ravel()[:1].reshape(()),
    "no row": lambda value: value[:0],
    "one row more": lambda value: np.concatenate([value, value[:1]]),
    "one row less": lambda value: value[:-1],
    "of float64": lambda value: value.astype(np.float64),
    "of int64": lambda value: value.astype(np.int64),
    "negative": lambda value: -np.ones_like(value),
    "NaN": lambda value: value * np.nan if value.dtype.kind == "f" else value * 0,
    "infinite": lambda value: np.full_like(value, np.inf) if value.dtype.kind == "f" else value * 0,
    "largest": lambda value: np.full_like(value, _info(value).max),
    "smallest": lambda value: np.full_like(value, _info(value).min),
}
NUMBERS: Final = (-1, 0, 0.5, 1e300, -1e300, 2**63, 10**400, float("nan"))


def _info(value: np.ndarray[Any, Any]) -> Any:
    return np.finfo(value.dtype) if value.dtype.kind == "f" else np.iinfo(value.dtype)


def leaves(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield every part of a tree with its path, but the tree itself; of a list, one of each type.

    The items of a list are read by the same lines, and what precedes the last one is whole.
    """
    items = {type(item): (place, item) for place, item in enumerate(tree)}
    parts = tree.items() if isinstance(tree, dict) else items.values()
    for name, part in parts:
        if name not in FREE:
            yield (*path, name), part
            if isinstance(part, dict | list):
                yield from leaves(part, (*path, name))


def changed(tree: Any, path: tuple[Any, ...], value: Any) -> Any:
    if not path:
        return value
    copy = tree.copy()
    copy[path[0]] = changed(tree[path[0]], path[1:], value)
    return copy


def accepted(records: tuple[Store, Path], kind: str, key: Key, spoiled: Any) -> bool:
    """Whether a map with such a record is read; else it must be refused by its name."""
    store, path = records
    before = store.read(kind, key)
    store.put(kind, key, spoiled)
    store.commit()
    line = refusal(lambda: read_map(path))
    store.put(kind, key, before)
    assert line is None or "map.recon" in line, line
    return line is None


KINDS: Final = (
    "session", "axes", "rig", "frames", "loops", "view", "rays", "submap", "submap_entry",
    "links",
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_nothing_is_refused_in_any_place(kind, records):
    key = records[0].keys(kind)[-1]
    tree = records[0].read(kind, key)
    optional = {"T_world_camera", "T_alone_camera", "fixes", "ndisp", "points"}
    for path, part in leaves(tree):
        for name, make in NOTHING.items():
            harmless = (
                (make(part) is None and path[-1] in optional)
                or (isinstance(part, str) and name == "a word")
                or (isinstance(part, list | dict) and name == "a tree")
                or path[-1] in {"frame", "kept"}
                or "linked" in path
            )
            fine = accepted(records, kind, key, changed(tree, path, make(part)))
            assert harmless or not fine, (path, name)


@pytest.mark.parametrize("kind", KINDS)
def test_impossible_arrays_and_numbers_are_harmless(kind, records):
    """Refused by name, or read to the end without an error: loops that trust them may crash."""
    key = records[0].keys(kind)[-1]
    tree = records[0].read(kind, key)
    for path, part in leaves(tree):
        if isinstance(part, np.ndarray):
            for make in ARRAYS.values():
                accepted(records, kind, key, changed(tree, path, make(part)))
        elif isinstance(part, int | float):
            for number in NUMBERS:
                accepted(records, kind, key, changed(tree, path, number))


REFUSED: Final[dict[str, tuple[str, tuple[Any, ...], Any]]] = {
    "scalar information": ("loops", ("closed", 0, "information"), 1.0),
    "information of NaN": ("loops", ("closed", 0, "information"), np.full((6, 6), np.nan)),
    "a loop beyond the drive": ("loops", ("closed", 0, "last"), FRAMES),
    "a loop back": ("loops", ("closed", 0, "first"), 2),
    "a link beyond the drive": ("links", ("links", 0, "loop", "last"), FRAMES),
    "a link to nobody": ("links", ("links", 0, "sessions"), [0, 7]),
    "linked by no list": ("links", ("linked",), 7),
    "times back": ("frames", ("times_s",), np.array([0.0, 2.0, 1.0])),
    "times of NaN": ("frames", ("times_s",), np.full(3, np.nan)),
    "a projective pose": ("frames", ("T_world_camera",), np.ones((3, 4, 4))),
    "float keys": ("submap", ("fused", "keys"), np.array([0.0, 1.0])),
    "negative keys": ("submap", ("fused", "keys"), -KEYS),
    "no keys": ("submap", ("fused", "keys"), KEYS[:0]),
    "voxels of no weight": ("submap", ("fused", "sums"), np.zeros((2, 11), np.float32)),
    "cells beyond a block": (
        "submap", ("occupancy", "rows", "cells"), np.array([0, 512], np.uint16),
    ),
    "blocks beyond the cells": (
        "submap", ("occupancy", "rows", "starts"), np.array([0, 1, 3], np.int64),
    ),
    "blocks backwards": ("submap", ("occupancy", "rows", "starts"), np.array([0, 5, 2], np.int64)),
    "another submap": ("submap", ("frames",), 1),
    "a unit of NaN": ("rays", ("grain", "unit_m"), float("nan")),
    "a focal length of 1e9": ("axes", ("camera", "focal_px"), 1e9),
    "a baseline of 1e300": ("axes", ("camera", "baseline_m"), 1e300),
    "a fix beyond the drive": ("loops", ("fixes", "frames"), np.array([0, 1, 5], np.int32)),
    "fixes of no sigma": ("loops", ("fixes", "sigma_m"), 0.0),
    "fixes of fewer positions": ("loops", ("fixes", "position_m"), np.ones((2, 3))),
    "no coarse disparity": ("view", ("keyframe", "coarse"), np.zeros((0, 2), np.float32)),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_record_that_fits_no_drive_is_refused(name, records):
    kind, path, value = REFUSED[name]
    key = records[0].keys(kind)[-1]
    tree = records[0].read(kind, key)
    assert not accepted(records, kind, key, changed(tree, path, value))


@pytest.mark.parametrize("key", ["", "1.0", "00", "+1", "1_0", "\u0661", " 1", "0,", "word"])
@pytest.mark.parametrize("kind", ["session", "frames", "view", "submap_entry"])
def test_a_key_of_no_number_is_refused(kind, key, records):
    store, path = records
    database = store._database
    database.execute("UPDATE record SET kind = 'kept' WHERE kind = ? AND key LIKE '1%'", (kind,))
    row = "SELECT ?, ?, tree, checksum, content FROM record WHERE kind = 'kept' LIMIT 1"
    database.execute(f"INSERT INTO record {row}", (kind, key))
    store.commit()
    line = refusal(lambda: read_map(path))
    database.execute("DELETE FROM record WHERE kind = ? AND key = ?", (kind, key))
    database.execute("UPDATE record SET kind = ? WHERE kind = 'kept'", (kind,))
    store.commit()
    assert "map.recon" in line


MOST_BYTES: Final = 64_000_000  # more than these files take, much less than they claim


@contextmanager
def little_memory() -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < MOST_BYTES, f"{peak / 1e6:.0f} MB"


def claim(path: Path, kind: str, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    """Change the first record of a kind, or make one, in a map that stays a valid file."""
    with Store.open(path) as store:
        keys = store.keys(kind)
        key = keys[0] if keys else 0
        content = store.read(kind, key, most_bytes=1 << 40) if keys else {}
        store.put(kind, key, change(content), compress=True)
        store.commit()


@pytest.fixture
def map_file(finished):
    return finished / "map" / "map.recon"


def assert_claims_too_much(map_file: Path) -> None:
    with little_memory():
        line = refusal(lambda: read_map(map_file)) or ""
    assert "claims more than it can hold" in line
    assert str(map_file) in line


@pytest.mark.parametrize("kind", [*KINDS, "state"])
def test_a_record_with_arrays_of_deflated_zeros_is_refused(kind, map_file):
    with little_memory():
        assert refusal(lambda: read_map(map_file)) is None
    zeros = {f"zeros{number}": np.zeros(5_000_000) for number in range(3)}
    claim(map_file, kind, lambda content: {**content, "claimed": zeros})
    assert map_file.stat().st_size < 10_000_000
    assert_claims_too_much(map_file)


def many(rows: int) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Make every array of a tree, and of those in it, as long; all zeros."""

    def longer(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return np.zeros((rows, *value.shape[1:]), value.dtype)
        if isinstance(value, dict):
            return {name: longer(item) for name, item in value.items()}
        return value

    return longer


ROWS: Final = {"frames": 10**6, "rays": 10**7, "view": 2 * 10**6, "submap": 2 * 10**6}


@pytest.mark.parametrize("kind", ROWS)
@pytest.mark.parametrize("neighbours", ["true", "forged"])
def test_a_record_of_very_many_rows_is_refused(kind, neighbours, map_file):
    claim(map_file, kind, many(ROWS[kind]))
    if neighbours == "forged":
        if kind != "view":  # before which a forged entry is noticed
            forged = {"voxels": 10**9, "cells": 10**9}
            claim(map_file, "submap_entry", lambda entry: {**entry, **forged})
        camera = RectifiedCamera(1e5, 5e4, 5e4, 5e4, 0.5, 100_000, 100_000).__dict__
        claim(map_file, "axes", lambda axes: {**axes, "camera": camera})
    assert_claims_too_much(map_file)


def test_an_octomap_of_few_nodes_that_cover_very_many_cells_is_refused(here):
    """Eight levels of one child each, then eight leaves of 256 cells along each side."""
    inner = struct.pack("<fB", 0.5, 1) * 7 + struct.pack("<fB", 0.5, 255)
    nodes = inner + struct.pack("<fB", 0.5, 0) * 8
    header = f"# Octomap OcTree file\nid OcTree\nsize {len(nodes) // 5}\nres 0.1\ndata\n"
    Path("claims.ot").write_bytes(header.encode() + nodes)
    with little_memory():
        line = refusal(lambda: read_octomap("claims.ot")) or ""
    assert line.startswith("claims.ot: the OctoMap claims far more cells than it has nodes")
