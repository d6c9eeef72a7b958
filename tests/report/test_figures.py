"""What figures show: their colours, lines, bars, limits and words."""

import base64
import io
import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.figure import Figure
from PIL import Image

from recon.core.errors import ShapeError
from recon.core.values import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    OccupancyTruth,
    Reason,
    RectifiedCamera,
    Trajectory,
)
from recon.core.values.arrays import UInt8
from recon.evaluation.paper import ABSOLUTE, AS_PRINTED, CORRECTED, TITLES
from recon.look.rig import RigChange
from recon.odometry.protocol import OdometryHealth
from recon.report import (
    audit_page,
    calibration_page,
    middlebury_page,
    pair_page,
    paper_page,
    rig_part,
    style,
)
from recon.report import drive_figures as figures
from recon.report.batch_page import sweep_figure
from recon.report.page import embedded
from recon.run.batch.job import Job, Outcome
from recon.run.batch.results import JobResult
from tests.scenery.calibrated import GOOD


def picture(png: bytes) -> UInt8:
    """The image in a PNG, at least 300 pixels wide to be readable, and not empty."""
    assert png.startswith(b"\x89PNG")
    found = cv2.imdecode(np.frombuffer(png, dtype=np.uint8), cv2.IMREAD_COLOR)
    assert found.shape[1] > 300
    assert found.std() > 1
    return np.asarray(found, dtype=np.uint8)


def colour(scale: str, place: int) -> np.ndarray:
    """One of the 256 colours of a matplotlib colormap."""
    return colormaps[scale](place, bytes=True)[:3]


def test_colours_of_disparities_and_errors_are_those_of_the_scale_and_near_is_red():
    values = np.array([[0.0, 10.0, np.nan, -5.0, 99.0]], dtype=np.float32)
    far, near, missing, below, above = style.colour_disparity(values, (0.0, 10.0))[0]
    assert (far == below).all()
    assert (near == above).all()
    np.testing.assert_array_equal([far, near], [colour("turbo", 0), colour("turbo", 255)])
    np.testing.assert_array_equal(missing, style.MISSING)
    far, near = style.colour_disparity(np.array([[20.0, 85.0]]), (0.0, 100.0))[0].astype(int)
    assert far[2] > far[0]
    assert near[0] > near[2]
    wrong, other, missing, far = style.colour_error(np.array([[2.0, -2.0, np.nan, 9.0]]), 4.0)[0]
    nothing, sure = style.colour_confidence(np.array([[0.0, 1.0]], dtype=np.float32))[0]
    np.testing.assert_array_equal(wrong, other)
    np.testing.assert_array_equal([missing, nothing], [style.MISSING] * 2)
    np.testing.assert_array_equal([far, sure], [colour("RdYlBu_r", 255), colour("viridis", 255)])
    assert style.value_range(np.array([np.nan, np.inf])) == (0.0, 1.0)
    assert style.value_range(np.array([4.0, 4.0, np.nan])) == (4.0, 5.0)
    assert style.value_range(np.arange(101.0)) == pytest.approx((1.0, 99.0))


def test_each_reason_has_a_colour_and_a_label_of_its_own():
    assert set(style.REASON_COLOURS) == set(style.REASON_LABELS) == set(Reason)
    assert len(set(style.REASON_COLOURS.values())) == len(Reason)
    assert len(set(style.REASON_LABELS.values())) == len(Reason)
    colours = style.colour_reasons(np.array([list(Reason)], dtype=np.uint8))[0]
    np.testing.assert_array_equal(colours, [style.REASON_COLOURS[reason] for reason in Reason])
    with pytest.raises(ShapeError, match="reason code is unknown"):
        style.colour_reasons(np.array([[len(Reason)]], dtype=np.uint8))


def test_a_grid_is_drawn_with_its_largest_y_on_top_in_cells_large_enough_to_be_seen():
    grid = OccupancyGrid(np.array([[0, 100], [-1, -1]], dtype=np.int8), 1.0, (0.0, 0.0))
    picture = style.colour_grid(grid)
    np.testing.assert_array_equal(picture[0], [style.GRID_UNKNOWN] * 2)
    np.testing.assert_array_equal(picture[1], [style.GRID_FREE, style.GRID_OCCUPIED])
    cells = np.array([[FREE, OCCUPIED], [OCCUPIED, FREE]], dtype=np.int8)
    grid, seen = OccupancyGrid(cells, 0.2, (0.0, 0.0)), np.array([[True, True], [True, False]])
    camera = RectifiedCamera(100.0, 49.5, 49.5, 49.5, 0.5, 100, 100)
    nothing = np.zeros((0, 3), np.int32), np.zeros(0, np.int32)
    truth = OccupancyTruth(grid, seen, *nothing, camera, np.eye(4)[None], 20.0, 3)
    image = style.colour_grid_errors(grid, truth)
    side = image.shape[0] // 2
    assert side == 750
    expected = style.colour_grid(grid)
    expected[0, 1] = style.GRID_NOT_COUNTED
    np.testing.assert_array_equal(image[::side, ::side], expected)


def notes(png: bytes) -> tuple[str, list[list[int]]]:
    """What a PNG says is seen in it, and which rectangles of it are pictures."""
    with Image.open(io.BytesIO(png)) as image:
        return image.info[style.SEEN], json.loads(image.info[style.PICTURES])


def test_figures_say_in_words_what_is_seen_in_this_run(
    pair, disparity, health, grid, nothing_found
):
    seen, boxes = notes(pair_page.disparity_figure(disparity, pair.camera))
    assert seen == "Disparities: 3.288 to 10 px, median 6.644 px; 75.0 % measured, 0.0 % inferred"
    seen, _ = notes(pair_page.disparity_figure(nothing_found, pair.camera))
    assert seen == "Disparities: nothing known; 0.0 % measured, 0.0 % inferred"
    assert len(boxes) == 2  # the map, and the bar with its colours
    seen, boxes = notes(figures.health_figure(health))
    assert "inlier tracks: 0 to 150, median 150. reprojection error (px): 0.2." in seen
    assert boxes == []
    seen, boxes = notes(figures.grid_figure(grid, {"path": np.array([[0.0, 1.0], [5.0, 2.5]])}))
    assert "Grid of 15 by 10 m, 33 % of the cells known, 90 % of them free" in seen
    assert "path 1 to 2.5, median 1.75" in seen
    assert len(boxes) == 4  # the grid, and the keys of its legend
    assert "measured 75.0 %, border 25.0 %" in notes(pair_page.reasons_figure(disparity))[0]


def test_a_dark_page_changes_paper_and_ink_but_no_colours_of_values(pair, disparity):
    shown = embedded(pair_page.disparity_figure(disparity, pair.camera))
    ink, picture = (
        np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))))
        for _, url in shown["layers"]
    )
    assert [kind for kind, _ in shown["layers"]] == ["ink", "picture"]
    values, below = np.s_[5:-140, 5:-5], np.s_[-15:]  # the label of the bar is at the bottom
    assert ink[values].min() > 250
    assert (picture[values][..., 3] == 255).all()
    assert ink[below].min() < 120
    assert (picture[below][..., 3] == 0).all()


@pytest.mark.parametrize("which", ["disparity", "nothing_found", "below zero"])
def test_every_figure_of_a_pair_is_a_png(which, pair, disparity, nothing_found):
    """With doffs, disparities may be negative; they have no depth here, where doffs is 0."""
    below = replace(disparity, values=disparity.values - 20)
    shown = {"disparity": disparity, "nothing_found": nothing_found}.get(which, below)
    found = pair_page.stereo_blocks(pair, shown)
    assert all(block.wide for block in found)
    assert f"{100 * shown.measured.mean():.1f} % of the pixels were measured." in found[1].caption
    for png in (*(block.png for block in found), pair_page.error_figure(shown.values)):
        picture(png)


def test_what_was_inferred_is_hatched_and_the_legend_says_so(pair, disparity, both):
    error_px = np.abs(both.values - 5)
    for draw in (
        lambda found: pair_page.disparity_figure(found, pair.camera),
        lambda found: pair_page.depth_figure(1 / found.values, found.inferred),
        lambda found: pair_page.error_figure(error_px, found.inferred),
    ):
        plain, hatched = picture(draw(disparity)), picture(draw(both))
        rows = slice(20, plain.shape[0] - 200)  # above legend and scale
        differs = (plain != hatched).any(axis=2)[rows]
        middle = plain.shape[1] // 2
        assert not differs[:, : middle - 5].any()
        assert 0.25 < differs[:, middle + 5 :].mean() < 0.55
        white = (hatched[rows, middle + 5 :] > 250).all(axis=2)
        assert white.mean() > 0.1
    with_legend = picture(pair_page.disparity_figure(both, pair.camera))
    assert (with_legend != picture(pair_page.disparity_figure(disparity, pair.camera)))[-220:].any()
    seen, _ = notes(pair_page.disparity_figure(both, pair.camera))
    assert "25.0 % measured, 50.0 % inferred" in seen


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (400, 7)])
def test_a_hatch_of_nothing_changes_nothing_and_one_of_all_leaves_most(shape):
    image = np.full((*shape, 3), 120, np.uint8)
    np.testing.assert_array_equal(style.hatch(image, np.zeros(shape, bool)), image)
    kept = (style.hatch(image, np.ones(shape, bool)) == 120).all(axis=2).mean()
    assert kept == 0 if shape == (1, 1) else 0.45 < kept < 0.7


def test_confidence_is_drawn_of_what_was_measured(both):
    shown = picture(pair_page.confidence_figure(both))
    alone = picture(pair_page.confidence_figure(both.only_measured()))
    np.testing.assert_array_equal(shown, alone)
    assert (shown[50, -50] < 40).all()


def test_a_figure_shows_its_picture(pair, disparity):
    image = picture(pair_page.disparity_figure(disparity, pair.camera)).astype(int)
    left, right = image[100, 20], image[100, -20]
    assert left.max() < 40  # no match: almost black
    assert right[2] > right[0] + 60  # near: red (OpenCV decodes to BGR)
    assert [pair_page.is_wide((10, width, 3)) for width in (19, 20)] == [False, True]
    assert [*disparity.reason_ratios.items()] == [(Reason.VALID, 0.75), (Reason.BORDER, 0.25)]


@pytest.mark.parametrize("frames", [0, 1, 3])
def test_path_of_any_length_is_drawn(frames, T_map_world):
    path, longer = (
        Trajectory(np.tile(np.eye(4), (n, 1, 1)), np.arange(float(n))) for n in (frames, frames + 1)
    )
    picture(figures.path_figure(path, path, T_map_world))
    for one in (path, longer):
        picture(figures.drift_figure(one, path))


def test_grids_health_and_times_are_drawn_whatever_is_known(grid, trajectory, T_map_world):
    path = figures.seen_from_above(trajectory, T_map_world)
    np.testing.assert_array_equal(path, np.column_stack([np.arange(11), np.zeros(11)]))
    unknown = OccupancyGrid(np.full((4, 5), -1, dtype=np.int8), 0.1, (0.0, 0.0))
    for one, paths in ((grid, {"path": path}), (grid, {}), (unknown, {})):
        picture(figures.grid_figure(one, paths))
    measured = [OdometryHealth(9, 8, 0.2, 0.1)] * 5
    for health in ([], [OdometryHealth()] * 3, [OdometryHealth(ok=False)], measured):
        picture(figures.health_figure(health))


def test_a_thinned_grid_keeps_its_obstacles_and_its_place():
    cells = np.full((7, 10), UNKNOWN, np.int8)
    cells[:3] = FREE
    cells[1, 9] = cells[6, 0] = OCCUPIED
    thinned = figures.thin_grid(OccupancyGrid(cells, 0.2, (-3.0, 4.0)), 4)
    assert (thinned.resolution_m, thinned.origin_m) == (pytest.approx(0.6), (-3.0, 4.0))
    expected = [[FREE, FREE, FREE, OCCUPIED], [UNKNOWN] * 4, [OCCUPIED, *[UNKNOWN] * 3]]
    np.testing.assert_array_equal(thinned.cells, expected)
    small = OccupancyGrid(np.zeros((3, 4), np.int8), 0.2, (0.0, 0.0))
    assert figures.thin_grid(small, 4) is small


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are drawn; none becomes a PNG."""
    found: list[Figure] = []
    monkeypatch.setattr(style, "to_png", lambda figure, _="": found.append(figure) or b"")
    return found


# The second is what Teddy has; the last, a wall.
@pytest.mark.parametrize("ends", [(4.1, 65.0), (1.25, 1.72), (0.31, 0.62), (50.1, 51.0)])
def test_every_depth_scale_has_several_marks(ends, drawn):
    pair_page.depth_figure(np.geomspace(*ends, 200).reshape(10, 20))
    bar = drawn[0].axes[1]
    low, high = bar.get_xlim()
    marks = [mark for mark in bar.get_xticks() if low <= mark <= high]
    assert 3 <= len(marks) <= 9
    assert (low, high) == pytest.approx(ends, rel=0.1)


def test_disparities_have_their_depths_above_them(pair, disparity, drawn):
    pair_page.disparity_figure(disparity, pair.camera)
    (upper,) = (
        axes for axes in drawn[0].axes if axes.get_xticklabels()[0].get_text().endswith("m")
    )
    depths = [float(label.get_text().removesuffix(" m")) for label in upper.get_xticklabels()]
    assert len(depths) >= 4
    camera = pair.camera
    expected = camera.focal_px * camera.baseline_m / (upper.get_xticks() + camera.doffs_px)
    np.testing.assert_allclose(depths, expected, rtol=0.01)


def test_path_is_drawn_with_truth_drift_and_frames_that_are_not_trusted_or_without(
    trajectory, T_map_world, health, drawn
):
    led = [replace(record, visual_m=(0.0, 0.1, 1.0)) for record in health]
    figures.path_figure(trajectory, trajectory, T_map_world, led, 0.1)
    figures.path_figure(trajectory, None, T_map_world)
    names = [[str(line.get_label()) for line in figure.axes[0].lines] for figure in drawn]
    given = ["truth", "estimate", "95 % (expected drift)", "visual alone", "not trusted (1)"]
    assert [[name for name in line if name[0] != "_"] for line in names] == [given, ["estimate"]]


def test_the_effect_of_the_patch_size_has_a_line_per_method(drawn):
    tried = [{"patch_px": px, "bad_percent": None, "valid_percent": 90.0} for px in (5, 9)]
    tried = [{**one, "avgerr_px": one["patch_px"] / 10} for one in tried]
    paper_page.patches_figure({CORRECTED: tried, AS_PRINTED: tried, ABSOLUTE: tried})
    wrong, error, valid = drawn[0].axes
    names = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert names == [TITLES[name] for name in (CORRECTED, AS_PRINTED, ABSOLUTE)]
    assert [len(line.get_xdata()) for line in wrong.lines] == [0, 0, 0]
    assert wrong.texts[0].get_text() == "no truth to compare with"
    np.testing.assert_array_equal(error.lines[1].get_xydata(), [[5, 0.5], [9, 0.9]])
    assert not error.texts + valid.texts


@pytest.mark.parametrize(("doffs_px", "curves"), [(0.0, 1), (20.0, 2)])
def test_depth_falls_with_disparity_as_the_camera_says(doffs_px, curves, drawn):
    camera = RectifiedCamera(500.0, 30.0, 20.0, 30.0 + doffs_px, 0.2, 60, 40, ndisp=80)
    paper_page.depth_curve_figure(camera, np.linspace(10, 20, 101, dtype=np.float32))
    (axes,) = drawn[0].axes
    assert len(axes.lines) == curves
    d, z = axes.lines[0].get_xydata().T
    np.testing.assert_allclose(z, 100.0 / (d + doffs_px))
    assert (d[0], d[-1], len(d)) == (0.2, 80.0, 400)
    (span,) = axes.patches
    assert (span.get_x(), span.get_width()) == pytest.approx((10.1, 9.8))


def test_confidence_is_drawn_bin_by_bin_and_thin_bins_are_left_out(drawn):
    bins = {"confidence": [0.25, 0.75], "right": [None, 0.5], "ratio": [0.0005, 0.9995]}
    steps = {"removed": [0, 0.5], "wrong": [0.2, 0.1], "best": [0.2, 0.0]}
    curves = {"reliability": bins, "ece": 0.125, "sparsification": steps, "ause": 0.5}
    middlebury_page.reliability_figure({"sad": curves, "sgm": curves})
    middlebury_page.sparsification_figure({"sad": curves})
    upper, lower = drawn[0].axes
    np.testing.assert_array_equal(upper.lines[1].get_xydata(), [[0.75, 0.5]])
    bars = [(bar.get_x(), bar.get_width()) for bar in lower.patches]
    np.testing.assert_allclose(bars, [(x, 0.225) for x in (0.0125, 0.5125, 0.2625, 0.7625)])
    left, best, _ = drawn[1].axes[0].lines
    np.testing.assert_allclose(left.get_xydata(), [[0, 20], [50, 10]])
    np.testing.assert_allclose(best.get_ydata(), [20, 0])
    assert left.get_label() == "sad: AUSE 0.500"


def test_points_lie_on_lines_of_their_colour_and_level_ones_are_rows_of_the_left(drawn):
    images, pixels = [np.zeros((40, 60), np.uint8)] * 2, [np.array([[5.0, 7.0], [50.0, 30.0]])] * 2
    lines = [[np.array([[0.0, 7.0], [59.0, 9.0]])] * 2] * 2
    calibration_page.epipolar_pictures((images, pixels, lines), (images, pixels), ": view 3")
    (raw, _), (_, level) = (figure.axes for figure in drawn)
    assert raw.get_title(loc="left") == "Left, as recorded: view 3"
    assert (raw.get_xlim(), raw.get_ylim()) == ((-0.5, 59.5), (39.5, -0.5))
    np.testing.assert_array_equal(level.lines[2].get_xydata(), [[0, 30], [59, 30]])
    for axes in (raw, level):
        one, point, other, _ = axes.lines
        np.testing.assert_array_equal(one.get_color(), point.get_color())
        assert not np.array_equal(one.get_color(), other.get_color())
    spread = calibration_page.spread_points(np.array([[0.0, y] for y in (9, 1, 5, 3, 7)]), 3)
    assert spread.tolist() == [1, 2, 0]


@pytest.mark.parametrize("name", ["US$5 and $_$", "a$\\frac{a$.jpg", "left\udcff.png", "links ä"])
def test_a_name_of_a_file_or_setting_is_drawn_and_no_formula(name, drawn):
    fit = SimpleNamespace(
        views=[SimpleNamespace(name=name)], dropped={}, errors_px=np.ones((1, 2)), rms_px=0.3
    )
    calibration_page.errors_figure(SimpleNamespace(fit=fit))
    jobs = [Job("a", "map", "", (), True, "", swept={"axes": text}) for text in (name, "other")]
    sweep_figure([JobResult(job, Outcome("succeeded"), {"points": 1.0}) for job in jobs])
    for figure in drawn:
        figure.savefig(io.BytesIO())  # raises where a formula or a text is none
        label = figure.axes[0].get_xticklabels()[0].get_text()
        assert label.replace("\\$", "$") == name.replace("\udcff", "\\udcff")
        assert ("$" in label) == ("\\$" in label)
    assert len(drawn) == 2


def test_each_view_of_a_calibration_has_its_error_and_corners(drawn):
    corners = SimpleNamespace(pixels=np.array([[1.0, 2.0], [3.0, 4.0]]))
    views = [SimpleNamespace(name=name, seen=(corners, corners)) for name in ("a", "b")]
    fit = SimpleNamespace(
        views=views, dropped={"c": 9.0}, errors_px=np.array([[0.1, 0.2], [0.3, 0.4]]), rms_px=0.3
    )
    result: Any = SimpleNamespace(
        fit=fit,
        seen=SimpleNamespace(size_px=(80, 60)),
        epipolar_error_px=np.linspace(-1, 1, 101),
        summary=replace(GOOD, coverage_left=0.5, coverage_right=0.75),
    )
    calibration_page.errors_figure(result)
    calibration_page.coverage_figure(result)
    calibration_page.epipolar_figure(result)
    errors, (_, right), rows = drawn[0].axes[0], drawn[1].axes, drawn[2].axes[0]
    assert [bar.get_height() for bar in errors.patches] == [0.1, 0.3, 0.2, 0.4, 9.0]
    middles = [bar.get_x() + bar.get_width() / 2 for bar in errors.patches]
    np.testing.assert_allclose(middles, [-0.2, 0.8, 0.2, 1.2, 2.0])
    assert right.get_title(loc="left") == "Right: 75 % of the cells"
    assert (right.get_xlim(), right.get_ylim()) == ((-0.5, 79.5), (59.5, -0.5))
    assert (right.get_xticks().tolist(), len(right.get_yticks())) == ([*range(10, 80, 10)], 5)
    assert len(rows.patches) == 60
    assert sum(bar.get_height() for bar in rows.patches) == pytest.approx(101, abs=2)


class Points(SimpleNamespace):
    def __len__(self) -> int:
        return len(self.left_uv)


def test_pairs_of_an_audit_are_drawn_by_frame(pair, drawn):
    def look(index: int, epipolar_error_px: list[float]) -> Any:
        features = Points(left_uv=np.arange(2.0 * len(epipolar_error_px)).reshape(-1, 2))
        return SimpleNamespace(
            index=index, features=features, epipolar_error_px=np.array(epipolar_error_px),
            brightness_dn=(90.0, 80.0 + index), sharpness=(0.5, 0.25),
        )  # fmt: skip

    looks = [look(0, [0.0, 1.0, 2.0]), look(4, [])]
    audit_page.frames_figure(looks)
    audit_page.epipolar_figure(look(2, [0.5, 9.0]), pair)
    brightness, sharpness, rows = drawn[0].axes
    np.testing.assert_array_equal(brightness.lines[1].get_xydata(), [[0, 80], [4, 84]])
    assert (brightness.get_ylim(), sharpness.get_ylim()[0]) == ((0, 255), 0)
    np.testing.assert_array_equal(rows.lines[0].get_xydata(), [[0, 1]])
    arrows = drawn[1].axes[0].collections[0]
    np.testing.assert_array_equal(arrows.V, [20 * 0.5])  # a wrong match is no arrow
    view = drawn[1].axes[0]
    assert (view.get_xlim(), view.get_ylim()) == ((-0.5, 59.5), (23.5, -0.5))


def test_frames_that_are_not_trusted_are_shaded(trajectory, health, drawn):
    T = np.array(trajectory.T_world_camera)
    T[:, 0, 3] = 0.1 * np.arange(11)
    figures.health_figure(health)
    figures.drift_figure(Trajectory(T, trajectory.timestamps_s), trajectory, health)
    for axes in (*drawn[0].axes, *drawn[1].axes):
        (span,) = axes.patches
        assert (span.get_x(), span.get_width()) == (4.5, 1.0)
    position, rotation = drawn[1].axes
    np.testing.assert_allclose(position.lines[0].get_ydata(), 0.1 * np.arange(11))
    assert rotation.lines[0].get_ydata().max() < 1e-6


def test_lines_of_an_audit_say_what_is_not_known():
    summary: dict[str, Any] = {
        "frames": 40, "frames_read": 10, "repeated_frames": 2, "frozen_left_frames": 0,
        "frozen_right_frames": 3, "usual_step_s": 0.1, "gaps": 1, "swapped_ratio": 0.25,
        "time_offset_frames": 0, "time_skew_frames": -0.001, "gain": 1.5, "sharpness_left": 0.5,
        "sharpness_right": None, "speed_m_per_s": 9.5, "focal_px": 700.0, "baseline_m": 0.5372,
        "field_of_view_deg": 80.0, "depth_error_m": {"10": 0.0312, "30": 0.0042, "90": 3.0},
        "disparity_5_50_95_px": [1.0, 5.0, 20.0],
    }  # fmt: skip
    lines = audit_page.audit_lines(summary)
    assert lines == {
        "frames": "40 at 10 Hz, 1 gap; 10 examined, 2 repeated, one camera frozen for 3",
        "rows": "not known",
        "left, right": "25 % of near features suggest swapped cameras",
        "time": "right camera +0.00 frames late",
        "brightness": "right / left 1.50",
        "sharpness": "not known",
        "disparities": "1.0 to 20.0 px (5 to 95 %), median 5.0 px",
        "rig": "baseline 54 cm, f 700 px (80 deg wide), moving at 9.5 m/s",
        "depth error": "3.1 cm at 10 m, 4.2 mm at 30 m, 3 m at 90 m",
    }
    turn = {"pitch_deg": 0.1, "yaw_deg": -0.2, "roll_deg": 0.0, "focal_percent": 0.25}
    lines = audit_page.audit_lines(summary | {"repaired": {**turn, "files": ["new.yaml"]}})
    assert re.match(r"new.yaml.* \+0.100 deg pitch, -0.200 deg yaw", lines["repaired"])
    off = {"disparity_px": {"mean": 0.0, "sigma": 0.1, "rms": 0.1}, "depth_percent": {}}
    for fixed in (True, False):
        lines = audit_page.audit_lines(summary | {"rig_by_motion": {**turn, **off, "fixed": fixed}})
        assert ("as in stabilised images" in lines["by its motion"]) is not fixed


@pytest.mark.parametrize(("off_px", "limit"), [(-2.0, 2.0), (0.01, 0.1), (math.nan, 0.1)])
def test_the_field_of_a_rig_is_drawn_around_no_change(off_px, limit, drawn):
    field = np.full((4, 8), off_px)
    field[0, :] = np.nan
    rig_part.field_figure(RigChange(30.0, field, np.zeros((4, 8))), (60, 24))
    axes, bar = drawn[0].axes
    assert (axes.get_xlim(), axes.get_ylim()) == ((-0.5, 59.5), (23.5, -0.5))
    assert bar.get_xlim() == (-limit, limit)
