"""A setting that is a constant now is read from files of before, and refused with another value."""

from __future__ import annotations

from typing import Any

import pytest

from recon.commands.config import ReconConfig, load_config
from recon.core.errors import SettingsError
from recon.core.settings import Settings

GROUPS: dict[str, Any] = {
    "matching.sad": ReconConfig().matching.sad,
    "matching.sgm": ReconConfig().matching.sgm,
    **dict(ReconConfig()),
}
FIXED = [
    (group, *one) for group, has in GROUPS.items() for one in getattr(has, "fixed", {}).items()
]


@pytest.mark.parametrize(("group", "name", "value"), FIXED)
def test_it_is_read_with_its_value_alone(group: str, name: str, value: Any) -> None:
    assert load_config(None, [{f"{group}.{name}": value}]) == ReconConfig()
    with pytest.raises(SettingsError, match=f"{group}.*{name} is fixed in this version"):
        load_config(None, [{f"{group}.{name}": 7}])


def test_a_setting_that_a_group_has_again_is_not_fixed() -> None:
    class Old(Settings):
        fixed = {"size": 1}  # noqa: RUF012

    class New(Old):
        size: int = 2

    assert New.parse({"size": 3}) == New(size=3)
    assert len(FIXED) > 14
