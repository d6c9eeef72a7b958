from __future__ import annotations

import typing
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import SettingsError
from recon.map.store.records import Store
from recon.odometry.protocol import Odometry, OdometryFrame
from recon.odometry.registry import ODOMETRIES, make_odometry
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
