from __future__ import annotations

from typing import Literal

import pytest
from pydantic import Field, ValidationError, field_validator

from recon.core.errors import SettingsError
from recon.core.settings import Settings


class Inner(Settings):
    window_px: int = Field(default=9, ge=1, description="Window.")

    @field_validator("window_px")
    @classmethod
    def _odd(cls, value: int) -> int:
        if value % 2 == 0:
            raise ValueError("an odd number is needed")
        return value


class Outer(Settings):
    inner: Inner = Inner()
    name: str = Field(default="a", description="Name.")


def test_settings_come_from_plain_values_and_give_them_back() -> None:
    settings = Outer.parse({"inner": {"window_px": 5}})
    assert settings == Outer(inner=Inner(window_px=5))
    assert Outer.parse(settings.model_dump()) == settings


def test_the_word_none_leaves_open_what_can_be_left_open() -> None:
    class Open(Settings):
        limit_m: float | None = Field(default=1.0, description="Limit.")
        kind: Literal["none", "all"] = Field(default="all", description="Kind.")

    assert Open.parse({"limit_m": "none", "kind": "none"}) == Open(limit_m=None, kind="none")
    with pytest.raises(SettingsError, match="inner"):
        Outer.parse({"inner": "none"})


def test_a_part_of_a_group_keeps_the_other_defaults_of_that_group() -> None:
    class Filtered(Settings):
        outer: Outer = Outer(inner=Inner(window_px=5), name="b")

    assert Filtered.parse({"outer": {"name": "c"}}).outer == Outer(
        inner=Inner(window_px=5), name="c"
    )
    assert Filtered.parse({"outer": {"inner": {}}}).outer.inner.window_px == 5


def test_settings_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        Outer().name = "b"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"nmae": "b"}, r"config\.yaml: unknown setting 'nmae'; .*lists them all"),
        ({"inner": {"window": 3}}, r"config\.yaml: unknown setting 'inner\.window'"),
        ({"inner": {"window_px": 0}}, r"setting 'inner\.window_px': .*greater than.*\(got 0\)"),
        ({"inner": {"window_px": "wide"}}, r"setting 'inner\.window_px': .*integer.*got 'wide'"),
        ({"inner": {"window_px": 4}}, r"setting 'inner\.window_px': an odd number is n.*\(got 4\)"),
        ({"inner": {"windw_px": 3}}, r"did you mean inner\.window_px\?"),
        ({"window_px": 3}, r"did you mean inner\.window_px\?"),
    ],
)
def test_a_bad_setting_is_named_with_its_path(values: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        Outer.parse(values, where="config.yaml")


def test_a_default_outside_its_bounds_is_refused() -> None:
    class Wrong(Settings):
        window_px: int = Field(default=0, ge=1, description="Window.")

    with pytest.raises(ValidationError):
        Wrong()
