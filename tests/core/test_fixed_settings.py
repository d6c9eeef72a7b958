"""A setting that is a constant now is read from files of before, and refused with another value."""

from __future__ import annotations

from typing import Any

import pytest

from recon.commands.config import ReconConfig, load_config
from recon.core.errors import SettingsError
from recon.core.settings import Settings

FIXED: dict[str, Any] = {
    "matching.sad.speckle_size_px": 50,
    "matching.sad.min_texture": 0.1,
    "matching.sad.half_size_first": True,
    "matching.sgm.speckle_size_px": 50,
    "cloud.min_confidence": 0.0,
    "occupancy.rays_per_voxel": 2,
    "occupancy.thin_surfaces": True,
    "grid.free_height_m": 0.8,
    "grid.occupied_probability": 0.55,
    "grid.free_probability": 0.35,
    "audit.frames": 300,
    "calibration.bootstrap": 500,
    "calibration.depths_m": [2.0, 5.0, 10.0, 20.0],
    "paper.patch_px": 11,
    "street.turn_deg_per_100m": 20.0,
}
"""What settings of before are fixed at."""


@pytest.mark.parametrize("name", FIXED)
def test_it_is_read_with_its_value_alone(name: str) -> None:
    assert load_config(None, [{name: FIXED[name]}]) == ReconConfig()
    group, _, last = name.rpartition(".")
    with pytest.raises(SettingsError, match=f"{group}.*{last} is fixed in this version"):
        load_config(None, [{name: 7}])


def test_a_setting_that_a_group_has_again_is_not_fixed() -> None:
    class Old(Settings):
        fixed = {"size": 1}  # noqa: RUF012

    class New(Old):
        size: int = 2

    assert New.parse({"size": 3}) == New(size=3)
