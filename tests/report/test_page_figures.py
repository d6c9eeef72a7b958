"""What the figures of single pages show: their lines, bars, limits and words."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from recon.core.values import RectifiedCamera, RectifiedPair, Trajectory
from recon.evaluation.paper import ABSOLUTE, AS_PRINTED, CORRECTED, TITLES
from recon.odometry.protocol import OdometryHealth
from recon.report import (
    audit_page,
    calibration_page,
    drive_figures,
    middlebury_page,
    paper_page,
    style,
)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are drawn; none becomes a PNG."""
    figures: list[Figure] = []
    monkeypatch.setattr(style, "to_png", lambda figure: figures.append(figure) or b"")
    return figures


def legend(figure: Figure) -> list[str]:
    (found,) = figure.legends
    return [text.get_text() for text in found.get_texts()]


def test_the_effect_of_the_patch_size_has_a_line_per_method(drawn: list[Figure]) -> None:
    tried = [{"patch_px": px, "bad_percent": None, "valid_percent": 90.0} for px in (5, 9)]
    tried = [{**one, "avgerr_px": one["patch_px"] / 10} for one in tried]
    paper_page.patches_figure({CORRECTED: tried, AS_PRINTED: tried, ABSOLUTE: tried})
    wrong, error, valid = drawn[0].axes
    assert legend(drawn[0]) == [TITLES[name] for name in (CORRECTED, AS_PRINTED, ABSOLUTE)]
    assert [len(line.get_xdata()) for line in wrong.lines] == [0, 0, 0]
    assert wrong.texts[0].get_text() == "no truth to compare with"
    np.testing.assert_array_equal(error.lines[1].get_xydata(), [[5, 0.5], [9, 0.9]])
    assert not error.texts + valid.texts


@pytest.mark.parametrize(("doffs_px", "curves"), [(0.0, 1), (20.0, 2)])
def test_depth_falls_with_disparity_as_the_camera_says(
    doffs_px: float, curves: int, drawn: list[Figure]
) -> None:
    camera = RectifiedCamera(500.0, 30.0, 20.0, 30.0 + doffs_px, 0.2, 60, 40, ndisp=80)
    paper_page.depth_curve_figure(camera, np.linspace(10, 20, 101, dtype=np.float32))
    (axes,) = drawn[0].axes
    assert len(axes.lines) == curves
    d, z = axes.lines[0].get_xydata().T
    np.testing.assert_allclose(z, 100.0 / (d + doffs_px))
    assert (d[0], d[-1], len(d)) == (0.2, 80.0, 400)
    (span,) = axes.patches
    assert (span.get_x(), span.get_width()) == pytest.approx((10.1, 9.8))


def test_confidence_is_drawn_bin_by_bin_and_thin_bins_are_left_out(drawn: list[Figure]) -> None:
    bins = {"confidence": [0.25, 0.75], "right": [None, 0.5], "share": [0.0005, 0.9995]}
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


def test_points_lie_on_lines_of_their_colour_and_level_ones_are_rows_of_the_left(
    drawn: list[Figure],
) -> None:
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


def test_each_view_of_a_calibration_has_its_error_and_corners(drawn: list[Figure]) -> None:
    corners = SimpleNamespace(pixels=np.array([[1.0, 2.0], [3.0, 4.0]]))
    views = [SimpleNamespace(name=name, seen=(corners, corners)) for name in ("a", "b")]
    fit = SimpleNamespace(
        views=views, dropped={"c": 9.0}, errors_px=np.array([[0.1, 0.2], [0.3, 0.4]]), rms_px=0.3
    )
    result: Any = SimpleNamespace(
        fit=fit,
        seen=SimpleNamespace(size_px=(80, 60)),
        rows_px=np.linspace(-1, 1, 101),
        summary={"coverage_left": 0.5, "coverage_right": 0.75},
    )
    calibration_page.errors_figure(result)
    calibration_page.coverage_figure(result)
    calibration_page.rows_figure(result)
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


def test_pairs_of_an_audit_are_drawn_by_frame(pair: RectifiedPair, drawn: list[Figure]) -> None:
    def look(index: int, rows_px: list[float]) -> Any:
        features = Points(left_uv=np.arange(2.0 * len(rows_px)).reshape(-1, 2))
        return SimpleNamespace(
            index=index, features=features, rows_px=np.array(rows_px),
            brightness_dn=(90.0, 80.0 + index), sharpness=(0.5, 0.25),
        )  # fmt: skip

    looks = [look(0, [0.0, 1.0, 2.0]), look(4, [])]
    audit_page.frames_figure(looks)
    audit_page.rows_figure(look(2, [0.5, 9.0]), pair)
    brightness, sharpness, rows = drawn[0].axes
    np.testing.assert_array_equal(brightness.lines[1].get_xydata(), [[0, 80], [4, 84]])
    assert (brightness.get_ylim(), sharpness.get_ylim()[0]) == ((0, 255), 0)
    np.testing.assert_array_equal(rows.lines[0].get_xydata(), [[0, 1]])
    arrows = drawn[1].axes[0].collections[0]
    np.testing.assert_array_equal(arrows.V, [20 * 0.5])  # a wrong match is no arrow


def test_frames_that_are_not_trusted_are_shaded(
    trajectory: Trajectory, health: list[OdometryHealth], drawn: list[Figure]
) -> None:
    T = np.array(trajectory.T_world_camera)
    T[:, 0, 3] = 0.1 * np.arange(11)
    drive_figures.health_figure(health)
    drive_figures.drift_figure(Trajectory(T, trajectory.timestamps_s), trajectory, health)
    for axes in (*drawn[0].axes, *drawn[1].axes):
        (span,) = axes.patches
        assert (span.get_x(), span.get_width()) == (4.5, 1.0)
    position, rotation = drawn[1].axes
    np.testing.assert_allclose(position.lines[0].get_ydata(), 0.1 * np.arange(11))
    assert rotation.lines[0].get_ydata().max() < 1e-6


def test_lines_of_an_audit_say_what_is_not_known() -> None:
    summary: dict[str, Any] = {
        "frames": 40, "frames_read": 10, "repeated_frames": 2, "frozen_left_frames": 0,
        "frozen_right_frames": 3, "usual_step_s": 0.1, "gaps": 1, "swapped_share": 0.25,
        "lag_frames": 0, "time_skew_frames": -0.001, "gain": 1.5, "sharpness_left": 0.5,
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
    off = {"value": -0.5, "sigma": 0.1}
    motion = dict.fromkeys(("disparity_px", "focal_percent", "lens_px"), off)
    summary |= {"rig_by_motion": {**motion, "depth_percent": {"10": 1.0}}, "lag_frames": 2}
    mended = {"pitch_deg": 0.1, "yaw_deg": -0.2, "roll_deg": 0.0, "focal_percent": 0.25}
    summary["mended"] = {**mended, "calibration": "new.yaml", "lenses_px": (0.5, 0.25)}
    lines = audit_page.audit_lines(summary)
    assert lines["time"] == "right camera +2 frames late"
    assert "lack -0.50 ± 0.20 px (depth +1.0 % at 10 m)" in lines["by its motion"]
    assert "by +0.100 deg pitch, -0.200 deg yaw, +0.000 deg roll" in lines["mended"]
    assert lines["mended"].endswith("both lenses straightened, by 0.50 and 0.25 px (rms)")
