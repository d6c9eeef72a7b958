from __future__ import annotations

import typing

import pytest

from recon.core.errors import SettingsError
from recon.odometry.protocol import Odometry
from recon.odometry.registry import ODOMETRIES, make_odometry
from recon.odometry.settings import OdometryName, OdometrySettings


@pytest.mark.parametrize("name", ODOMETRIES)
def test_every_odometry_keeps_the_protocol(name: str) -> None:
    assert isinstance(make_odometry(name), Odometry)


def test_an_unknown_name_lists_the_choices() -> None:
    with pytest.raises(SettingsError, match="one of: fused, kiss, visual"):
        make_odometry("lidar")


def test_the_settings_offer_what_there_is() -> None:
    assert set(typing.get_args(OdometryName)) == set(ODOMETRIES)
    assert OdometrySettings().method == "fused"


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
