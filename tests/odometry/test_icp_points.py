from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from recon.odometry import kiss
from recon.odometry.kiss import consistent, select_points, textured
from recon.odometry.protocol import OdometryFrame

See = Callable[..., OdometryFrame]


def test_selected_points_lie_on_the_street(see: See) -> None:
    xyz = select_points(see(np.eye(4)), 30.0).xyz
    walls = np.stack(
        [xyz[:, 1] - 1.6, xyz[:, 0] + 4.0, xyz[:, 0] - 5.0, xyz[:, 1] + 4.0, xyz[:, 2] - 40.0]
    )
    assert len(xyz) > 1000
    # float32 at some tens of metres.
    assert np.abs(walls).min(axis=0).max() < 1e-4


def test_range_and_accuracy_bound_the_selection(see: See, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = see(np.eye(4))
    every = select_points(frame, 30.0)
    monkeypatch.setattr(kiss, "_MIN_RANGE_M", 6.0)
    monkeypatch.setattr(kiss, "_MAX_SIGMA_M", 0.2)
    cloud = select_points(frame, 20.0)
    assert cloud.xyz[:, 2].min() >= 6.0
    assert cloud.xyz[:, 2].max() <= 20.0
    assert cloud.sigma_m is not None
    assert cloud.sigma_m.max() <= 0.2
    assert 0 < len(cloud) < len(every)


def test_only_change_along_the_row_is_texture() -> None:
    rows = np.zeros((20, 20), np.uint8)
    rows[10:] = 200
    assert not textured(rows, 100.0).any()
    assert textured(np.ascontiguousarray(rows.T), 100.0).any()


def test_a_lone_disparity_is_not_consistent(see: See) -> None:
    frame = see(np.eye(4))
    values = np.full_like(frame.disparity.values, 10.0)
    values[50, 50] = 20.0
    good = consistent(replace(frame.disparity, values=values), 0.5)
    assert not good[50, 50]
    assert good.sum() == good.size - 1


def test_pixels_at_the_rim_of_the_unknown_are_not_consistent(see: See, blind: See) -> None:
    unknown = blind().disparity
    assert not consistent(unknown, 0.5).any()


def test_a_frame_without_disparity_gives_no_points(blind: See) -> None:
    assert len(select_points(blind(), 30.0)) == 0
