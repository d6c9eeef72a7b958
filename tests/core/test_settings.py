"""Numbers in text are ASCII decimals; errors and settings are one clear line; bounds are kept."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import pytest
from pydantic import Field, ValidationError, field_validator

from recon.cli.options import parse_numbers as parse_option
from recon.commands.config import ReconConfig, load_config
from recon.core.errors import MissingDependencyError, ReconError, SettingsError, require
from recon.core.machine import parse_size_mb
from recon.core.settings import Settings
from recon.core.text import (
    is_count,
    metres,
    parse_integer,
    parse_number,
    unit_of,
    with_unit,
)
from recon.evaluation.trajectory import TrajectoryRules
from recon.io.cameras.contents import read_contents
from recon.io.fields import parse_yaml
from recon.io.files import read_table
from recon.io.models.ply import read_ply
from recon.io.trajectory import read_frames
from recon.rig.capture import RecordingSettings
from recon.sources.times import read_dates, read_stamped_names
from recon.street.settings import StreetScene
from tests.scenery.bounds import numbers_of

pytestmark = pytest.mark.portable

FOREIGN = ["1_0", "١٢", "1_0.5", "\uff11\uff12"]
PLY = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
READERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "table": (lambda path: read_table(path, (2,)), "1 {}\n"),
    "frames": (read_frames, "left.png,right.png,0.5,{}\n"),
    "stamps": (read_stamped_names, "{} image.png\n"),
    "dates": (read_dates, "2011-09-26 13:02:{}.964\n"),
    "cloud": (read_ply, PLY + "property float z\nend_header\n1 2 {}\n"),
}


@pytest.mark.parametrize("text", FOREIGN)
def test_numbers_settings_and_options_are_decimals_and_other_notations_none(text):
    for number in ("1", "-1.5", "+.5", "1e-05", "7."):
        assert parse_number(number) == float(number)
    assert not is_count(text)
    for parse in (parse_number, parse_integer):
        with pytest.raises(ValueError, match=r"not a decimal number|invalid literal"):
            parse(text)
    for setting in (f"fusion.voxel_m={text}", f"audit.baseline_m=[0.1, {text}]"):
        with pytest.raises(ReconError, match="number"):
            load_config(None, [setting])
    with pytest.raises(ReconError, match="--antenna"):
        parse_option(f"1,{text},3", "--antenna")
    with pytest.raises(ReconError):
        parse_size_mb(f"{text}M")


@pytest.mark.parametrize("reader", READERS)
def test_readers_take_decimals_alone(tmp_path, reader):
    read, content = READERS[reader]
    (tmp_path / "file").write_text(content.format("10"), encoding="utf-8")
    read(tmp_path / "file")
    for text in FOREIGN:
        (tmp_path / "file").write_text(content.format(text), encoding="utf-8")
        with pytest.raises(ReconError):
            read(tmp_path / "file")


@pytest.mark.parametrize("text", [*FOREIGN, "0x10", "1:30"])
def test_numbers_of_old_yaml_are_text(tmp_path, text):
    assert parse_yaml(f"value: {text}", "x.yaml") == {"value": text}
    (tmp_path / "rig.yml").write_text(f"%YAML:1.0\n---\nfx: {text}\n", encoding="utf-8")
    assert read_contents(tmp_path / "rig.yml") == {"fx": text}
    decimals = "[10, 010, -2, 0.5, 1.5e+3, -.inf, true]"
    assert parse_yaml(decimals, "x.yaml") == [10, 10, -2, 0.5, 1500.0, -float("inf"), True]


@pytest.mark.parametrize(
    "setting", ["fusion.voxel_m=0,2", "fusion.voxel_m=-0,2", "audit.baseline_m=['0,1', 2]"]
)
def test_a_setting_with_a_decimal_comma_is_refused_for_it(setting):
    with pytest.raises(ReconError, match=r"decimals need a point.*: -?0\.[12]"):
        load_config(None, [setting])


def test_a_length_has_three_digits_that_count_and_no_exponent():
    lengths = {0: "0 m", 0.0019: "0.00190 m", -0.25: "-0.250 m", 12.345: "12.3 m", 1234.5: "1234 m"}
    assert [metres(length) for length in lengths] == [*lengths.values()]
    assert (metres(0.25, "+"), metres(-0.25, "+")) == ("+0.250 m", "-0.250 m")
    assert (metres(1e-15), metres(float("nan"))) == ("0.000000 m", "nan m")


UNITS = {
    "path_length_m": "m", "trajectory.r_rel_deg_per_100m": "°/100 m", "speed_m_per_s": "m/s",
    "trajectory.t_rel_percent at 100 m": "%", "peak_memory_mb": "MB", "fps": "frames/s",
    "seconds": "s", "seconds.match": "s", "seconds_per_frame.p95": "s",
    "live.latency_ms.p50": "ms", "disparity.bad.0.5": "%", "disparity.quantiles_px.50": "px",
    "depth_error_cm.10.calibration": "cm", "precision at 0.2 m": "", "frames": "",
    "frames_not_trusted": "", "map.f_score": "", "m": "",
}  # fmt: skip


@pytest.mark.parametrize("name", UNITS)
def test_a_figure_has_the_unit_that_its_name_tells(name):
    assert unit_of(name) == UNITS[name]
    assert with_unit("3", name) == f"3 {UNITS[name]}".strip()


@pytest.mark.parametrize(
    ("parts", "line"),
    [
        ({}, "wrong"),
        ({"got": 0}, "wrong (got 0)"),
        ({"got": "a\n  b\t c"}, "wrong (got a b c)"),
        ({"where": "f", "expected": "3", "hint": "crop it"}, "f: wrong (expected 3); crop it"),
        ({"where": Path("a/b"), "got": 2, "expected": 3}, "a/b: wrong (got 2, expected 3)"),
    ],
)
def test_the_line_of_an_error_has_the_known_parts(parts, line):
    assert str(ReconError("wrong", **parts)) == line  # type: ignore[arg-type]


def test_an_optional_package_is_imported_and_a_missing_one_gets_the_pip_line():
    assert require("json", extra="ros").dumps([1]) == "[1]"
    words = r"'no_such_thing'.*pip install 'recon-stereo\[ros\]'"
    with pytest.raises(MissingDependencyError, match=words):
        require("no_such_thing", extra="ros")


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


def test_the_word_none_leaves_open_and_a_part_of_a_group_keeps_its_other_defaults():
    class Open(Settings):
        limit_m: float | None = Field(default=1.0, description="Limit.")
        kind: Literal["none", "all"] = Field(default="all", description="Kind.")

    assert Open.parse({"limit_m": "none", "kind": "none"}) == Open(limit_m=None, kind="none")
    with pytest.raises(SettingsError, match="inner"):
        Outer.parse({"inner": "none"})

    class Filtered(Settings):
        outer: Outer = Outer(inner=Inner(window_px=5), name="b")

    found = Filtered.parse({"outer": {"name": "c"}})
    assert found.outer == Outer(inner=Inner(window_px=5), name="c")
    assert Filtered.parse({"outer": {"inner": {}}}).outer.inner.window_px == 5
    assert Filtered.parse(found.model_dump()) == found


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
def test_a_bad_setting_is_named_with_its_path(values, message):
    with pytest.raises(SettingsError, match=message):
        Outer.parse(values, where="config.yaml")


def test_settings_cannot_be_changed_and_keep_their_bounds():
    class Wrong(Settings):
        window_px: int = Field(default=0, ge=1, description="Window.")

    with pytest.raises(SettingsError, match=r"name: settings do not change; recon.load_config"):
        Outer().name = "b"
    with pytest.raises(ValidationError):
        Wrong()


@pytest.mark.parametrize("settings", [ReconConfig, TrajectoryRules, RecordingSettings, StreetScene])
def test_every_number_has_two_bounds(settings):
    open_ended = [one.name for one in numbers_of(settings) if None in (one.low, one.high)]
    assert open_ended == []


@pytest.mark.parametrize("number", [*numbers_of(ReconConfig)], ids=lambda number: number.name)
def test_a_number_beyond_its_bounds_is_refused_in_one_line(number):
    step = 1 if number.whole else 1e-9 * max(1.0, abs(number.low), abs(number.high))
    ends = zip((number.low, number.high), number.outside, strict=True)
    far = ("1e300", "-1e300", ".inf", "-.inf", ".nan", "1" + "0" * 30, "-1" + "0" * 30)
    near = (number.low - step, number.high + step, *(end for end, outside in ends if outside))
    for value in (*far, *near):
        text = f"[{', '.join([str(value)] * number.count)}]" if number.count else f"{value}"
        with pytest.raises(SettingsError, match=number.name) as raised:
            load_config(None, [f"{number.name}={text}"])
        assert "\n" not in str(raised.value)
