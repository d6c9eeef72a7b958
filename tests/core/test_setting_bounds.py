"""Every number among the settings has a bound on both sides, and beyond it is refused."""

from __future__ import annotations

import pytest

from recon.commands.config import ReconConfig, load_config
from recon.core.errors import SettingsError
from recon.core.settings import Settings
from recon.evaluation.trajectory import TrajectoryRules
from recon.rig.capture import RecordingSettings
from recon.street.settings import StreetScene
from tests.scenery.bounds import Number, numbers_of

NUMBERS = list(numbers_of(ReconConfig))
BY_NAME = pytest.mark.parametrize("number", NUMBERS, ids=lambda number: number.name)


@pytest.mark.parametrize("settings", [ReconConfig, TrajectoryRules, RecordingSettings, StreetScene])
def test_every_number_has_two_bounds(settings: type[Settings]) -> None:
    open_ended = [one.name for one in numbers_of(settings) if None in (one.low, one.high)]
    assert open_ended == []


def _given(number: Number, value: object) -> list[str]:
    count = number.count
    text = f"[{', '.join([str(value)] * count)}]" if count else f"{value}"
    return [f"{number.name}={text}"]


@BY_NAME
@pytest.mark.parametrize(
    "value", ["1e300", "-1e300", ".inf", "-.inf", ".nan", "1" + "0" * 30, "-1" + "0" * 30]
)
def test_an_extreme_number_is_refused_in_one_line(number: Number, value: str) -> None:
    with pytest.raises(SettingsError) as told:
        load_config(None, _given(number, value))
    assert number.name in str(told.value)
    assert "\n" not in str(told.value)


@BY_NAME
def test_a_number_just_beyond_its_bounds_is_refused(number: Number) -> None:
    assert number.low is not None
    assert number.high is not None
    step = 1 if number.whole else 1e-9 * max(1.0, abs(number.low), abs(number.high))
    for value in (number.low - step, number.high + step):
        with pytest.raises(SettingsError, match=number.name):
            load_config(None, _given(number, value))
    for value, refused in zip((number.low, number.high), number.outside, strict=True):
        if refused:
            with pytest.raises(SettingsError, match=number.name):
                load_config(None, _given(number, value))
