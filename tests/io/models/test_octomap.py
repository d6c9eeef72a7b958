"""OctoMap files are read by pyoctomap with the same cells, values and axes."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pyoctomap
import pytest

from recon.core.errors import FormatError, MappingError
from recon.core.values import OccupancyVoxels
from recon.io.models.octomap import KEY_LIMIT, octomap_pieces, read_octomap, write_octomap_tiles
from tests.scenery.octomaps import write_octomap


def _scene() -> OccupancyVoxels:
    """Cells without symmetry, on both sides of every axis, with one full block of 8 to prune."""
    rng = np.random.default_rng(0)
    keys = np.unique(rng.integers((-40, -7, -3), (90, 30, 12), (3000, 3)), axis=0)
    block = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1)
    log_odds = rng.choice([-1.9, -0.41, 0.3, 3.4], len(keys))
    return OccupancyVoxels(
        np.vstack([keys, block + np.array([200, 0, 0])]).astype(np.int32),
        np.concatenate([log_odds, np.full(8, 2.5)]).astype(np.float32),
        0.2,
    )


def _sorted(voxels: OccupancyVoxels) -> tuple[np.ndarray, np.ndarray]:
    order = np.lexsort(voxels.keys.T)
    return voxels.keys[order], voxels.log_odds[order]


def test_an_ot_file_keeps_cells_and_log_odds(tmp_path: Path) -> None:
    scene = _scene()
    _, full = write_octomap(tmp_path / "octomap", scene)
    back = read_octomap(full)
    assert back.resolution_m == 0.2
    for ours, theirs in zip(_sorted(scene), _sorted(back), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def _by_pyoctomap(voxels: OccupancyVoxels) -> tuple[bytes, bytes]:
    """The contents of the ``.ot`` and the ``.bt`` file that OctoMap itself writes."""
    tree = pyoctomap.OcTree(voxels.resolution_m)
    tree.setClampingThresMin(1e-6)
    tree.setClampingThresMax(1.0 - 1e-6)
    cells = zip(voxels.centres_m.tolist(), voxels.log_odds.tolist(), strict=True)
    for centre, value in cells:
        tree.updateNode(centre, value, True)
    tree.updateInnerOccupancy()
    return bytes(tree.write()), bytes(tree.writeBinary())


def _random_voxels(seed: int, reach: int, number: int) -> OccupancyVoxels:
    rng = np.random.default_rng(seed)
    keys = np.unique(rng.integers(-reach, reach, (number, 3)), axis=0).astype(np.int32)
    # Mostly free, and dense where the reach is small: many nodes are pruned.
    log_odds = rng.choice([-1.0, -1.0, -1.0, -1.0, -1.0, -0.3, 2.0], len(keys))
    return OccupancyVoxels(keys, log_odds.astype(np.float32), 0.2)


@pytest.mark.parametrize(
    ("reach", "number"), [(5, 1), (6, 9000), (30, 20_000), (700, 3000), (KEY_LIMIT, 500)]
)
def test_files_are_those_of_octomap_byte_for_byte(tmp_path: Path, reach: int, number: int) -> None:
    voxels = _random_voxels(reach, reach, number)
    binary, full = write_octomap(tmp_path / "map", voxels)
    assert (full.read_bytes(), binary.read_bytes()) == _by_pyoctomap(voxels)


@pytest.mark.parametrize("depth", [1, 3, 6, 11])
def test_a_map_in_tiles_gives_the_same_files(tmp_path: Path, depth: int) -> None:
    voxels = _random_voxels(2, 40, 6000)
    write_octomap(tmp_path / "whole", voxels)
    tile = voxels.keys[:, :2] >> depth
    tiles = [
        OccupancyVoxels(voxels.keys[inside], voxels.log_odds[inside], 0.2)
        for column in np.unique(tile, axis=0)
        for inside in [(tile == column).all(axis=1)]
    ]
    write_octomap_tiles(tmp_path / "tiled", tiles[::-1], depth, 0.2)
    for end in ("bt", "ot"):
        tiled, whole = (tmp_path / f"{name}.{end}" for name in ("tiled", "whole"))
        assert tiled.read_bytes() == whole.read_bytes()


@pytest.mark.parametrize("cell", [-KEY_LIMIT - 1, KEY_LIMIT])
def test_a_map_too_large_for_octomap_is_refused(tmp_path: Path, cell: int) -> None:
    voxels = OccupancyVoxels(np.array([[0, cell, 0]], np.int32), np.ones(1, np.float32), 0.2)
    with pytest.raises(MappingError, match="too large"):
        write_octomap(tmp_path / "map", voxels)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("nodes_each", [1, 7, 1000, 10**9])
def test_a_file_is_read_in_pieces_in_its_order(tmp_path: Path, nodes_each: int) -> None:
    _, full = write_octomap(tmp_path / "map", _random_voxels(3, 8, 2000))
    whole, pieces = read_octomap(full), list(octomap_pieces(full, nodes_each))
    assert len(pieces) > 1 or nodes_each == 10**9
    assert {piece.resolution_m for piece in pieces} == {0.2}
    np.testing.assert_array_equal(np.concatenate([piece.keys for piece in pieces]), whole.keys)
    np.testing.assert_array_equal(
        np.concatenate([piece.log_odds for piece in pieces]), whole.log_odds
    )


def test_a_piece_takes_memory_for_its_cells_alone(tmp_path: Path) -> None:
    _, full = write_octomap(tmp_path / "map", _random_voxels(5, 60, 200_000))
    cells = sum(len(piece) for piece in octomap_pieces(full, 1000))  # compiles the kernel
    tracemalloc.start()
    assert sum(len(piece) for piece in octomap_pieces(full, 1000)) == cells > 180_000
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # A cell is 16 bytes: the whole would be 3 MB, and twice that while it is made.
    assert peak_bytes < 3e5


def test_pruned_leaves_of_octomaps_own_files_are_expanded(tmp_path: Path) -> None:
    keys = np.stack(np.unravel_index(np.arange(12**3), (12, 12, 12)), axis=1) - 4
    tree = pyoctomap.OcTree(0.2)
    for centre in ((keys + 0.5) * 0.2).tolist():
        tree.updateNode(centre, 1.5)  # leaves that have become alike are pruned at once
    pruned = bytes(tree.write())
    assert pruned.count(np.float32(1.5).tobytes()) < len(keys) / 2
    (tmp_path / "pruned.ot").write_bytes(pruned)
    back = read_octomap(tmp_path / "pruned.ot")
    assert sorted(back.keys.tolist()) == sorted(keys.tolist())
    np.testing.assert_array_equal(back.log_odds, np.float32(1.5))


def _damage(content: bytes, kind: str) -> bytes:
    data = content.index(b"data\n") + len(b"data\n")
    if kind == "cut":
        return content[:-3]
    if kind == "no tree":
        return content[: data - len(b"data\n")]
    if kind == "more nodes than the tree has":
        size = content[content.index(b"size ") :].split(b"\n")[0]
        more = b"size %d" % (int(size.split()[1]) + 1)
        return content.replace(size, more) + bytes(5)
    if kind == "leaf without children near the root":
        return content[: data + 4] + b"\0" + content[data + 5 :]
    if kind == "not a number":
        return content[:-5] + np.float32(np.nan).tobytes() + content[-1:]
    return content.replace(b"id OcTree", b"id ColorOcTree")


@pytest.mark.parametrize(
    "kind",
    [
        "cut",
        "no tree",
        "more nodes than the tree has",
        "leaf without children near the root",
        "not a number",
        "another tree",
    ],
)
def test_a_damaged_ot_file_is_a_format_error(tmp_path: Path, kind: str) -> None:
    _, full = write_octomap(tmp_path / "map", _random_voxels(4, 30, 3000))
    full.write_bytes(_damage(full.read_bytes(), kind))
    words = "ColorOcTree" if kind == "another tree" else "truncated or damaged"
    with pytest.raises(FormatError, match=words):
        read_octomap(full)
