"""The unit of a figure, by its name."""

from __future__ import annotations

import pytest

from recon.core.text import unit_of, with_unit


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("path_length_m", "m"),
        ("trajectory.r_rel_deg_per_100m", "°/100 m"),
        ("trajectory.t_rel_percent at 100 m", "%"),
        ("speed_m_per_s", "m/s"),
        ("peak_memory_mb", "MB"),
        ("fps", "frames/s"),
        ("seconds", "s"),
        ("seconds.match", "s"),
        ("seconds_per_frame.p95", "s"),
        ("live.latency_ms.p50", "ms"),
        ("disparity.bad.0.5", "%"),
        ("disparity.quantiles_px.50", "px"),
        ("depth_error_cm.10.calibration", "cm"),
        ("precision at 0.2 m", ""),
        ("frames", ""),
        ("frames_not_trusted", ""),
        ("map.f_score", ""),
        ("m", ""),
    ],
)
def test_a_figure_has_the_unit_that_its_name_tells(name: str, unit: str) -> None:
    assert unit_of(name) == unit
    assert with_unit("3", name) == f"3 {unit}".strip()
