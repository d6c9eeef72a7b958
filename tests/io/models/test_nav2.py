"""Nav2 maps follow the published rules, on an asymmetric scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from recon.io.models.nav2 import read_nav2, write_nav2

# Row 0 has the smallest y. An obstacle at the right of the lowest row, unknown at the top left.
CELLS = np.array([[FREE, FREE, FREE, OCCUPIED], [FREE] * 4, [UNKNOWN, FREE, FREE, FREE]], np.int8)
GRID = OccupancyGrid(CELLS, 0.2, (-3.4, 1.25))


def test_a_map_is_read_back_as_it_was(tmp_path: Path) -> None:
    image, description = write_nav2(tmp_path / "map" / "grid", GRID)
    assert (image.name, description.name) == ("grid.pgm", "grid.yaml")
    back = read_nav2(description)
    np.testing.assert_array_equal(back.cells, GRID.cells)
    assert back.resolution_m == GRID.resolution_m
    assert back.origin_m == GRID.origin_m


def test_the_first_row_of_the_image_has_the_largest_y(tmp_path: Path) -> None:
    image, _ = write_nav2(tmp_path / "grid", GRID)
    header, pixels = image.read_bytes()[:11], image.read_bytes()[11:]
    assert header == b"P5\n4 3\n255\n"
    assert list(pixels) == [205, 254, 254, 254, 254, 254, 254, 254, 254, 254, 254, 0]


def test_a_world_file_places_the_image_in_a_gis(tmp_path: Path) -> None:
    write_nav2(tmp_path / "grid", GRID)
    x_step, y_turn, x_turn, y_step, x_m, y_m = map(
        float, (tmp_path / "grid.wld").read_text().split()
    )
    # Of the centre of the upper left pixel, which is the first column of the last row.
    assert (x_m, y_m) == pytest.approx((-3.4 + 0.1, 1.25 + 2.5 * 0.2))
    assert (x_step, y_turn, x_turn, y_step) == (0.2, 0, 0, -0.2)


def test_the_yaml_file_says_what_nav2_asks(tmp_path: Path) -> None:
    _, description = write_nav2(tmp_path / "grid", GRID)
    assert yaml.safe_load(description.read_text()) == {
        "image": "grid.pgm",
        "mode": "trinary",
        "resolution": 0.2,
        "origin": [-3.4, 1.25, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }


def test_a_negated_map_with_comments_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.pgm").write_bytes(b"P5\n# made by hand\n2 1\n255\n\xff\x00")
    fields = {"image": "a.pgm", "resolution": 0.5, "origin": [0, 0, 0], "negate": 1}
    fields |= {"occupied_thresh": 0.65, "free_thresh": 0.196}
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(fields))
    assert read_nav2(tmp_path / "a.yaml").cells.tolist() == [[OCCUPIED, FREE]]


def test_the_origin_is_written_as_it_is_meant(tmp_path: Path) -> None:
    origin_m = (-646 * 0.1, 3 * 0.1)
    assert origin_m == (-64.60000000000001, 0.30000000000000004)
    _, path = write_nav2(tmp_path / "grid", OccupancyGrid(np.zeros((2, 2), np.int8), 0.1, origin_m))
    assert yaml.safe_load(path.read_text())["origin"] == [-64.6, 0.3, 0.0]
    assert "-64.6\n" in path.read_text()
    assert read_nav2(path).origin_m == (-64.6, 0.3)
