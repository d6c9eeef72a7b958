"""A cloud as 3D Tiles: every point once, in boxes that contain it, coarse ones first."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import OutputError
from recon.core.values import PointCloud, join_clouds
from recon.io.models.las import NODE_CELLS
from recon.io.models.tiles3d import write_tiles3d

SQUARE_M = 16.0
LOW_M = np.array([-32.0, -16.0, -32.0])
SIDE_M = 64.0


def street(column: int, row: int, count: int = 20_000) -> PointCloud:
    """Points on uneven ground in one square of the plane."""
    rng, corner = np.random.default_rng([column + 9, row + 9]), np.array([column, row])
    xy = (rng.random((count, 2)) + corner) * SQUARE_M * (1 - 1e-6)
    z = 0.2 * np.sin(xy.sum(axis=1)) + rng.choice([0.0, 6.0], count)
    return PointCloud(
        np.column_stack([xy, z]).astype(np.float32),
        rgb=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        sigma_m=rng.random(count).astype(np.float32),
        inferred=rng.integers(0, 2, count).astype(np.uint8),
        frame="map",
    )


SQUARES = ((-2, -1), (-1, 0), (0, 0), (1, 2))


def write(folder: Path, clouds, spacing_m: float = 0.1) -> int:
    return write_tiles3d(folder, clouds, LOW_M, SIDE_M, SQUARE_M, spacing_m)


def read(path: Path) -> dict[str, np.ndarray]:
    """The columns of a tile, by the specification alone."""
    content = path.read_bytes()
    magic, version, size, *sizes = struct.unpack_from("<4s6I", content)
    assert (magic, version, size) == (b"pnts", 1, len(content))
    ends = 28 + np.cumsum(sizes)
    assert ends[-1] == size
    assert not (ends % 8).any()
    head, numbers = json.loads(content[28 : ends[0]]), json.loads(content[ends[1] : ends[2]])
    count, found = head.pop("POINTS_LENGTH"), {}
    for name, entry in head.items():
        kind, at = (np.uint8 if name == "RGB" else "<f4"), ends[0] + entry["byteOffset"]
        found[name] = np.frombuffer(content, kind, 3 * count, at).reshape(-1, 3)
    for name, entry in numbers.items():
        assert (entry["componentType"], entry["type"]) == ("FLOAT", "SCALAR")
        found[name] = np.frombuffer(content, "<f4", count, ends[2] + entry["byteOffset"])
    return found


def tiles_of(folder: Path) -> list[tuple[dict, dict, int]]:
    """All tiles below the root of a tileset, with the one above and the depth of each."""
    whole = json.loads((folder / "tileset.json").read_text())
    assert whole["asset"] == {"version": "1.0"}
    assert whole["geometricError"] >= whole["root"]["geometricError"] > 0
    assert whole["root"]["refine"] == "ADD"
    left, found = [(whole["root"], 0)], []
    while left:
        above, depth = left.pop()
        own = [(one, above, depth) for one in above.get("children", [])]
        found += own
        left += [(one, depth + 1) for one, _, _ in own]
    return found


def box(tile: dict) -> np.ndarray:
    values = np.array(tile["boundingVolume"]["box"])
    half = values[3:].reshape(3, 3)
    assert np.array_equal(half, np.diag(np.diag(half)))
    return np.stack([values[:3] - np.diag(half), values[:3] + np.diag(half)])


def sorted_rows(*columns: np.ndarray) -> np.ndarray:
    table = np.column_stack(columns).astype(np.float64)
    return table[np.lexsort(table.T)]


@pytest.mark.parametrize("spacing_m", [0.1, 1.0, 100.0])
def test_every_point_is_in_one_tile_with_what_is_known_of_it(tmp_path, spacing_m):
    clouds = [street(*square) for square in SQUARES]
    assert write(tmp_path / "a", clouds, spacing_m) == sum(map(len, clouds))
    tiles = tiles_of(tmp_path / "a")
    uris = [tile["content"]["uri"] for tile, _, _ in tiles]
    assert {*uris, "tileset.json"} == {path.name for path in (tmp_path / "a").iterdir()}
    parts = [read(tmp_path / "a" / uri) for uri in uris]
    assert [len(part["POSITION"]) for part in parts] == [t["extras"]["points"] for t, _, _ in tiles]
    names = ("POSITION", "RGB", "sigma_m", "inferred")
    found = sorted_rows(*(np.concatenate([part[name] for part in parts]) for name in names))
    whole = join_clouds(clouds)
    expected = sorted_rows(whole.xyz, whole.rgb, whole.sigma_m, whole.inferred)
    np.testing.assert_array_equal(found, expected)


def test_boxes_contain_points_and_what_is_below_and_errors_fall(tmp_path):
    write(tmp_path, [street(*square) for square in SQUARES])
    tiles = tiles_of(tmp_path)
    assert max(depth for _, _, depth in tiles) >= 2
    for tile, above, _ in tiles:
        (low, high), (outer_low, outer_high) = box(tile), box(above)
        assert (low >= outer_low - 1e-9).all()
        assert (high <= outer_high + 1e-9).all()
        xyz = read(tmp_path / tile["content"]["uri"])["POSITION"]
        assert (xyz >= low - 1e-9).all()
        assert (xyz <= high + 1e-9).all()
        assert 0 <= tile["geometricError"] < above["geometricError"]
        assert (tile["geometricError"] == 0) == ("children" not in tile)


def test_the_coarsest_tile_has_a_point_in_each_of_its_cells_of_all_squares(tmp_path):
    clouds = [street(*square) for square in SQUARES]
    write(tmp_path, clouds)
    [(top, _, _)] = [one for one in tiles_of(tmp_path) if one[2] == 0]
    cell_m = SIDE_M / NODE_CELLS
    assert top["extras"]["spacing_m"] == cell_m

    def cells(xyz: np.ndarray) -> np.ndarray:
        return np.floor((xyz - LOW_M) / cell_m)

    drawn = cells(read(tmp_path / top["content"]["uri"])["POSITION"])
    assert len(np.unique(drawn, axis=0)) == len(drawn)
    seen = np.unique(cells(join_clouds(clouds).xyz), axis=0)
    np.testing.assert_array_equal(np.unique(drawn, axis=0), seen)


def test_a_square_is_on_disk_before_the_next_is_made(tmp_path):
    """But for its coarsest points: however many it has, no more than there are cells."""
    left, count = [], 150_000

    def clouds():
        total = 0
        for square in SQUARES:
            cloud = street(*square, count)
            total += len(cloud)
            yield cloud
            stored = sum(len(read(path)["POSITION"]) for path in tmp_path.glob("*.pnts"))
            left.append(total - stored)

    write(tmp_path, clouds())
    assert max(np.diff(left, prepend=0)) < 0.15 * count


def test_points_without_colours_outside_the_cube_and_single_ones_are_kept(tmp_path):
    far = PointCloud(np.float32([[900, 900, 900], [-900, 5, -900]]), frame="map")
    one = PointCloud(np.float32([[1, 2, 3]]), frame="map")
    for n, cloud in enumerate((far, one)):
        assert write(tmp_path / str(n), [cloud]) == len(cloud)
        tiles = tiles_of(tmp_path / str(n))
        parts = [read(tmp_path / str(n) / tile["content"]["uri"]) for tile, _, _ in tiles]
        assert {name for part in parts for name in part} == {"POSITION"}
        found = np.concatenate([part["POSITION"] for part in parts])
        np.testing.assert_array_equal(sorted_rows(found), sorted_rows(cloud.xyz))
        ends = np.stack([box(tile) for tile, _, _ in tiles])
        assert (ends[:, 0].min(axis=0) <= cloud.xyz.min(axis=0)).all()
        assert (ends[:, 1].max(axis=0) >= cloud.xyz.max(axis=0)).all()


def test_without_a_point_nothing_is_written_and_a_file_in_the_way_is_named(tmp_path):
    empty = PointCloud(np.zeros((0, 3), np.float32), frame="map")
    assert write(tmp_path / "none", [empty, empty]) == 0
    assert not (tmp_path / "none").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write the file"):
        write(tmp_path / "file", [street(0, 0, 10)])
