from __future__ import annotations

import numpy as np
import pytest
from matplotlib import colormaps

from recon.core.errors import ShapeError
from recon.core.values import (
    FREE,
    OCCUPIED,
    OccupancyGrid,
    OccupancyTruth,
    Reason,
    RectifiedCamera,
)
from recon.report.style import (
    GRID_FREE,
    GRID_OCCUPIED,
    GRID_UNKNOWN,
    MISSING,
    REASON_COLOURS,
    REASON_LABELS,
    colour_confidence,
    colour_disparity,
    colour_error,
    colour_grid,
    colour_grid_errors,
    colour_reasons,
    value_range,
)


def scale(name: str) -> np.ndarray:
    """The 256 colours of a matplotlib colormap."""
    return colormaps[name](np.arange(256), bytes=True)[:, :3]


def test_lowest_and_highest_disparity_get_the_ends_of_the_scale() -> None:
    values = np.array([[0.0, 10.0, np.nan, -5.0, 99.0]], dtype=np.float32)
    colours = colour_disparity(values, (0.0, 10.0))
    first, last = scale("turbo")[[0, 255]]
    np.testing.assert_array_equal(colours[0, [0, 3]], [first, first])
    np.testing.assert_array_equal(colours[0, [1, 4]], [last, last])
    np.testing.assert_array_equal(colours[0, 2], MISSING)


def test_near_is_red_and_far_is_blue() -> None:
    values = np.array([[20.0, 85.0]], dtype=np.float32)
    far, near = colour_disparity(values, (0.0, 100.0))[0].astype(int)
    assert far[2] > far[0]
    assert near[0] > near[2]


@pytest.mark.parametrize("value", [np.nan, 3.0, np.inf])
def test_a_map_of_one_value_or_none_is_coloured(value: float) -> None:
    colours = colour_disparity(np.full((2, 3), value, dtype=np.float32))
    assert colours.shape == (2, 3, 3)
    assert colours.dtype == np.uint8


def test_range_ignores_what_is_not_finite_and_is_never_empty() -> None:
    assert value_range(np.array([np.nan, np.inf])) == (0.0, 1.0)
    assert value_range(np.array([4.0, 4.0, np.nan])) == (4.0, 5.0)
    low, high = value_range(np.arange(101.0))
    assert (low, high) == pytest.approx((1.0, 99.0))


def test_error_colours_depend_on_its_size_alone() -> None:
    colours = colour_error(np.array([[2.0, -2.0, np.nan]], dtype=np.float32), 4.0)
    np.testing.assert_array_equal(colours[0, 0], colours[0, 1])
    np.testing.assert_array_equal(colours[0, 2], MISSING)


def test_no_confidence_is_coloured_as_missing() -> None:
    colours = colour_confidence(np.array([[0.0, 1.0]], dtype=np.float32))
    np.testing.assert_array_equal(colours[0, 0], MISSING)
    np.testing.assert_array_equal(colours[0, 1], scale("viridis")[255])


def test_each_reason_has_a_colour_and_a_label_of_its_own() -> None:
    assert set(REASON_COLOURS) == set(REASON_LABELS) == set(Reason)
    assert len(set(REASON_COLOURS.values())) == len(set(REASON_LABELS.values())) == len(Reason)
    codes = np.array([list(Reason)], dtype=np.uint8)
    np.testing.assert_array_equal(colour_reasons(codes)[0], list(REASON_COLOURS.values()))


def test_an_unknown_reason_is_refused() -> None:
    with pytest.raises(ShapeError, match="reason code is unknown"):
        colour_reasons(np.array([[len(Reason)]], dtype=np.uint8))


def test_grid_is_drawn_with_its_largest_y_on_top() -> None:
    grid = OccupancyGrid(np.array([[0, 100], [-1, -1]], dtype=np.int8), 1.0, (0.0, 0.0))
    picture = colour_grid(grid)
    np.testing.assert_array_equal(picture[0], [GRID_UNKNOWN, GRID_UNKNOWN])
    np.testing.assert_array_equal(picture[1], [GRID_FREE, GRID_OCCUPIED])


def test_each_cell_of_a_small_grid_is_large_enough_to_be_seen() -> None:
    cells = np.array([[FREE, OCCUPIED], [OCCUPIED, FREE]], dtype=np.int8)
    grid = OccupancyGrid(cells, resolution_m=0.2, origin_m=(0.0, 0.0))
    truth = OccupancyTruth(
        grid=grid,
        seen=np.ones((2, 2), dtype=np.bool_),
        keys=np.zeros((0, 3), dtype=np.int32),
        frames=np.zeros(0, dtype=np.int32),
        camera=RectifiedCamera(100.0, 49.5, 49.5, 49.5, 0.5, 100, 100),
        T_map_camera=np.eye(4)[None],
        range_m=20.0,
        least_frames=3,
    )
    picture = colour_grid_errors(grid, truth)
    side = picture.shape[0] // 2
    assert side > 100
    np.testing.assert_array_equal(picture[::side, ::side], colour_grid(grid))
