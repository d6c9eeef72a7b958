from __future__ import annotations

import numpy as np
import pytest
from matplotlib import colormaps

from recon.core.errors import ShapeError
from recon.core.values import FREE, OCCUPIED, OccupancyGrid, OccupancyTruth, Reason, RectifiedCamera
from recon.report import style


def colour(scale: str, place: int) -> np.ndarray:
    """One of the 256 colours of a matplotlib colormap."""
    return colormaps[scale](place, bytes=True)[:3]


def test_colours_of_disparities_are_those_of_the_scale_and_near_is_red() -> None:
    values = np.array([[0.0, 10.0, np.nan, -5.0, 99.0]], dtype=np.float32)
    far, near, missing, below, above = style.colour_disparity(values, (0.0, 10.0))[0]
    assert (far == below).all()
    assert (near == above).all()
    np.testing.assert_array_equal([far, near], [colour("turbo", 0), colour("turbo", 255)])
    np.testing.assert_array_equal(missing, style.MISSING)
    far, near = style.colour_disparity(np.array([[20.0, 85.0]]), (0.0, 100.0))[0].astype(int)
    assert far[2] > far[0]
    assert near[0] > near[2]


@pytest.mark.parametrize("value", [np.nan, 3.0, np.inf])
def test_a_map_of_one_value_or_none_is_coloured(value: float) -> None:
    colours = style.colour_disparity(np.full((2, 3), value, dtype=np.float32))
    assert (colours.shape, colours.dtype) == ((2, 3, 3), np.uint8)


def test_range_ignores_what_is_not_finite_and_is_never_empty() -> None:
    assert style.value_range(np.array([np.nan, np.inf])) == (0.0, 1.0)
    assert style.value_range(np.array([4.0, 4.0, np.nan])) == (4.0, 5.0)
    assert style.value_range(np.arange(101.0)) == pytest.approx((1.0, 99.0))


def test_error_colours_depend_on_its_size_alone_up_to_the_limit() -> None:
    wrong, other, missing, far = style.colour_error(np.array([[2.0, -2.0, np.nan, 9.0]]), 4.0)[0]
    np.testing.assert_array_equal(wrong, other)
    np.testing.assert_array_equal(missing, style.MISSING)
    np.testing.assert_array_equal(far, colour("RdYlBu_r", 255))


def test_no_confidence_is_coloured_as_missing() -> None:
    nothing, sure = style.colour_confidence(np.array([[0.0, 1.0]], dtype=np.float32))[0]
    np.testing.assert_array_equal(nothing, style.MISSING)
    np.testing.assert_array_equal(sure, colour("viridis", 255))


def test_each_reason_has_a_colour_and_a_label_of_its_own() -> None:
    assert set(style.REASON_COLOURS) == set(style.REASON_LABELS) == set(Reason)
    assert len(set(style.REASON_COLOURS.values())) == len(Reason)
    assert len(set(style.REASON_LABELS.values())) == len(Reason)
    colours = style.colour_reasons(np.array([list(Reason)], dtype=np.uint8))[0]
    np.testing.assert_array_equal(colours, [style.REASON_COLOURS[reason] for reason in Reason])
    with pytest.raises(ShapeError, match="reason code is unknown"):
        style.colour_reasons(np.array([[len(Reason)]], dtype=np.uint8))


def test_grid_is_drawn_with_its_largest_y_on_top() -> None:
    grid = OccupancyGrid(np.array([[0, 100], [-1, -1]], dtype=np.int8), 1.0, (0.0, 0.0))
    picture = style.colour_grid(grid)
    np.testing.assert_array_equal(picture[0], [style.GRID_UNKNOWN] * 2)
    np.testing.assert_array_equal(picture[1], [style.GRID_FREE, style.GRID_OCCUPIED])


def test_each_cell_of_a_small_grid_is_large_enough_to_be_seen() -> None:
    cells = np.array([[FREE, OCCUPIED], [OCCUPIED, FREE]], dtype=np.int8)
    grid = OccupancyGrid(cells, resolution_m=0.2, origin_m=(0.0, 0.0))
    truth = OccupancyTruth(
        grid=grid,
        seen=np.array([[True, True], [True, False]]),
        keys=np.zeros((0, 3), dtype=np.int32),
        frames=np.zeros(0, dtype=np.int32),
        camera=RectifiedCamera(100.0, 49.5, 49.5, 49.5, 0.5, 100, 100),
        T_map_camera=np.eye(4)[None],
        range_m=20.0,
        least_frames=3,
    )
    picture = style.colour_grid_errors(grid, truth)
    side = picture.shape[0] // 2
    assert side == 750
    expected = style.colour_grid(grid)
    expected[0, 1] = style.GRID_NOT_COUNTED
    np.testing.assert_array_equal(picture[::side, ::side], expected)


@pytest.mark.parametrize(("width", "colour"), [(2.0, style.BAD), (1.0, "#000000")])
def test_places_are_shaded_around_their_middle(width: float, colour: str) -> None:
    figure, (upper, lower) = style.stacked(3.0, "x", ("one", "two"))
    style.shade(upper, [3.0, 7.0], width, colour)
    spans = [(patch.get_x(), patch.get_width()) for patch in upper.patches]
    assert spans == [(3.0 - width / 2, width), (7.0 - width / 2, width)]
    assert [axes.get_ylabel() for axes in (upper, lower)] == ["one", "two"]
    assert (upper.get_xlabel(), lower.get_xlabel()) == ("", "x")
    assert style.to_png(figure).startswith(b"\x89PNG")
