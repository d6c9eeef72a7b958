from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from recon.core.geometry.se3 import invert, make_transform
from recon.map.store.records import Store
from recon.odometry import fused, gate
from recon.odometry.fused import FusedOdometry
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.odometry.registry import make_odometry
from recon.odometry.settings import OdometrySettings

See = Callable[..., OdometryFrame]


def follow(frames: Iterable[OdometryFrame], icp_every: int = 4) -> list[OdometryResult]:
    odometry = FusedOdometry(OdometrySettings())
    with patch.object(fused, "_ICP_EVERY", icp_every):
        return [odometry.register(frame) for frame in frames]


def error_m(result: OdometryResult, truth: np.ndarray) -> float:
    return float(np.linalg.norm((invert(truth) @ result.T_world_camera)[:3, 3]))


@pytest.fixture(scope="module")
def results(street: tuple[OdometryFrame, ...]) -> list[OdometryResult]:
    return follow(street, icp_every=1)


def test_the_street_is_followed(results: list[OdometryResult], street_poses: np.ndarray) -> None:
    # 1 % of 5.5 m.
    assert error_m(results[-1], street_poses[-1]) < 0.055
    assert all(result.health.ok for result in results)


def test_health_measures_every_frame_but_the_first(results: list[OdometryResult]) -> None:
    for result in results[1:]:
        health = result.health
        assert 0.7 < health.overlap <= 1.0
        # Exact disparity on planes: far less than the 0.3 m voxel.
        assert 0.0 < health.residual_m < 0.02
        assert 0.0 <= health.correction_m < 0.2
        assert health.icp_points > 300
        assert health.inliers <= health.tracks
    assert np.isnan(results[0].health.overlap)


def test_what_is_refused_says_why(results: list[OdometryResult]) -> None:
    for result in results[1:]:
        assert result.health.accepted or result.health.notes


def test_two_runs_are_equal_to_the_bit(
    results: list[OdometryResult], street: tuple[OdometryFrame, ...]
) -> None:
    for once, again in zip(results, follow(street, icp_every=1), strict=True):
        np.testing.assert_array_equal(once.T_world_camera, again.T_world_camera)


def test_a_sure_prior_asks_icp_now_and_then(
    street: tuple[OdometryFrame, ...],
    street_poses: np.ndarray,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # An ICP that is never better than this cannot help.
    monkeypatch.setattr(gate, "_ICP_FLOOR_M", 1.0)
    monkeypatch.setattr(gate, "_ICP_FLOOR_DEG", 10.0)
    found = follow(street, icp_every=5)
    asked = [index for index, result in enumerate(found) if result.health.icp_points]
    assert asked == [0, 5, 10]
    assert error_m(found[-1], street_poses[-1]) < 0.055


@pytest.mark.parametrize("name", ["visual", "kiss", "fused"])
def test_a_saved_odometry_goes_on_to_the_bit(
    name: str, street: tuple[OdometryFrame, ...], tmp_path: Path
) -> None:
    unbroken = make_odometry(name)
    for frame in street[:6]:
        unbroken.register(frame)
    saved = make_odometry(name)
    with Store.create(tmp_path / "map.recon") as store:
        store.put("state", 0, unbroken.state())
        saved.restore(store.read("state", 0))
    for frame in street[6:]:
        ours, theirs = saved.register(frame), unbroken.register(frame)
        np.testing.assert_array_equal(ours.T_world_camera, theirs.T_world_camera)
        assert repr(ours.health) == repr(theirs.health)


def test_poses_stay_rigid(results: list[OdometryResult]) -> None:
    for result in results:
        R = result.T_world_camera[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_blind_frames_extrapolate_leave_the_map_alone_and_are_recovered_from(
    blind: See, street: tuple[OdometryFrame, ...], street_poses: np.ndarray
) -> None:
    results = follow((*street[:5], blind(index=5), blind(255, index=6), *street[7:]))
    assert [r.health.ok for r in results[4:7]] == [True, False, False]
    assert any("too few points" in note for note in results[5].health.notes)
    # The motion is constant, so it is extrapolated well; after that ICP and vision go on.
    for result, truth in zip(results, street_poses, strict=True):
        assert error_m(result, truth) < 0.2
    assert results[-1].health.ok


def test_a_drive_that_begins_blind_begins_where_it_sees(
    blind: See, street: tuple[OdometryFrame, ...]
) -> None:
    results = follow((blind(), blind(), *street[:4]))
    np.testing.assert_allclose(results[2].T_world_camera, np.eye(4), atol=1e-12)
    assert results[0].health.ok
    assert not results[1].health.ok
    assert results[-1].health.ok


def test_icp_takes_over_where_vision_is_lost(
    see: See,
    street: tuple[OdometryFrame, ...],
    street_poses: np.ndarray,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without tracks, but with a disparity map, the map still tells that the car swerves."""
    odometry = FusedOdometry(OdometrySettings())
    results = [odometry.register(frame) for frame in street[:6]]
    monkeypatch.setattr("recon.odometry.visual.locate_camera", lambda *_: None)
    swerved = street_poses[6:9] @ make_transform(np.eye(3), np.array([0.2, 0.0, 0.0]))
    results += [odometry.register(see(T, index)) for index, T in enumerate(swerved, 6)]
    lost = results[6:]
    assert any(result.health.accepted and result.health.ok for result in lost)
    assert all("lost" in result.health.notes[0] for result in lost)
    # Along the street the walls hardly tell; extrapolation stands in.
    assert error_m(lost[-1], swerved[-1]) < 0.15
