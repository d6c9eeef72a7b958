from __future__ import annotations

import typing
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import RegistrationError, SettingsError
from recon.core.geometry.se3 import invert
from recon.core.values import Trajectory
from recon.map.store.records import Store
from recon.odometry.protocol import Odometry, OdometryFrame
from recon.odometry.registry import ODOMETRIES, KnownPoses, make_odometry
from recon.odometry.settings import OdometryName, OdometrySettings


@pytest.mark.parametrize("name", ODOMETRIES)
def test_every_odometry_keeps_the_protocol(name: str) -> None:
    assert isinstance(make_odometry(name), Odometry)


@pytest.mark.parametrize("name", ODOMETRIES)
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


def test_an_unknown_name_lists_the_choices() -> None:
    with pytest.raises(SettingsError, match="one of: kiss, visual"):
        make_odometry("lidar")


def test_the_settings_offer_what_there_is() -> None:
    assert set(typing.get_args(OdometryName)) == set(ODOMETRIES)
    assert OdometrySettings().method == "visual"


def test_runs_of_older_versions_were_visual_too() -> None:
    assert OdometrySettings.parse({"method": "fused"}).method == "visual"


@pytest.mark.parametrize(
    "values",
    [
        {"method": "lidar"},
        {"prior": {"axis": "body"}},
        {"prior": {"sigma_m": 0}},
        {"max_range_m": 0},
    ],
)
def test_what_is_no_setting_is_refused(values: dict[str, object]) -> None:
    with pytest.raises(SettingsError):
        OdometrySettings.parse(values)


See = Callable[..., OdometryFrame]


def known(poses: np.ndarray) -> KnownPoses:
    return KnownPoses(Trajectory(poses, np.arange(len(poses), dtype=np.float64)))


def test_poses_begin_at_the_identity(blind: See, street_poses: np.ndarray) -> None:
    odometry = known(street_poses[3:])
    for index in range(4):
        result = odometry.register(blind(index=index))
        expected = invert(street_poses[3]) @ street_poses[3 + index]
        np.testing.assert_allclose(result.T_world_camera, expected, atol=1e-12)
        assert result.health.ok
        assert result.health.known


def test_poses_are_picked_by_the_number_of_the_frame(blind: See, street_poses: np.ndarray) -> None:
    odometry = known(street_poses)
    odometry.register(blind(index=2))
    result = odometry.register(blind(index=7))
    np.testing.assert_allclose(
        result.T_world_camera, invert(street_poses[2]) @ street_poses[7], atol=1e-12
    )


def test_a_frame_without_a_pose_is_reported(blind: See, street_poses: np.ndarray) -> None:
    odometry = known(street_poses[:2])
    with pytest.raises(RegistrationError, match=r"frame 2: no known pose .* \(got 2 poses"):
        odometry.register(blind(index=2))


def test_it_is_an_odometry(street_poses: np.ndarray) -> None:
    assert isinstance(known(street_poses), Odometry)
