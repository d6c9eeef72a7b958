"""The command line: options name settings, help is whole, and settings are listed as they are."""

import inspect
import json
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.main
from typer.testing import CliRunner, Result

from recon.cli import app
from recon.cli.drive_options import DriveOptions, StartInMap, read_start
from recon.cli.evaluate import app as evaluate
from recon.cli.options import Shared, survey_of, takes_groups
from recon.commands.config import (
    PAIR_DEFAULTS,
    ReconConfig,
    SettingEntry,
    list_settings,
    load_config,
    settings_page,
)
from recon.core.errors import SettingsError
from recon.core.settings import setting_names
from recon.export.make import PRODUCTS
from recon.map.localize.sequence import StartPose
from recon.map.sessions.measured import Survey
from recon.stereo.match.registry import MATCHERS
from tests.docs.blocks import ROOT

pytestmark = pytest.mark.portable

SEEN: list[ReconConfig] = []
probe = typer.Typer()


@probe.command()
@takes_groups
def see(start: StartInMap = None, *, reading: DriveOptions, shared: Shared) -> None:
    with shared.one_line_errors():
        SEEN.append(shared.settings())


@pytest.mark.parametrize(
    ("line", "settings"),
    [
        ("", {}),
        ("--set odometry.method=kiss --threads 2", {"odometry.method": "kiss"}),
        ("--start 2 --end 9 --stride 3", {"source.start": 2, "source.end": 9, "source.stride": 3}),
        ("--start 1,2,90", {}),
        ("--left 0 --right null", {"source.left": "0", "source.right": "null"}),
        ("--focal 300 --cx 0", {"source.focal_px": 300, "source.cx_px": 0}),
        ("--calib rig.yaml", {"source.calibration": "rig.yaml"}),
        ("--set matching.matcher=sad --matcher sgm", {"matching.matcher": "sgm"}),
        ("--memory-limit 1.5G", {"memory.limit_mb": 1500}),
    ],
)
def test_what_is_given_is_set(line, settings):
    done = CliRunner().invoke(probe, line.split())
    assert done.exit_code == 0, done.output
    assert SEEN.pop() == load_config(None, [settings])


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--memory-limit much", "cannot read this size"),
        ("--start 1,2", "--start"),
        ("--focal -1", "source.focal_px"),
    ],
)
def test_what_is_no_value_of_its_setting_is_refused(line, words):
    done = CliRunner().invoke(probe, line.split())
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
    assert words in done.stderr


def test_every_option_that_names_a_setting_names_one_that_there_is():
    commands = [one.callback for one in (*app.registered_commands, *evaluate.registered_commands)]
    options = [p for one in commands for p in inspect.signature(one or see).parameters.values()]
    marks = [mark for one in options for mark in getattr(one.annotation, "__metadata__", ())]
    named = [mark.setting for mark in marks if isinstance(getattr(mark, "setting", None), str)]
    assert len(named) > 50
    assert {*named} <= {*setting_names(ReconConfig)}


def test_positions_of_a_survey_and_the_begin_of_a_drive_are_read():
    positions = Path("gnss.txt")
    assert survey_of(None, None) is None
    assert survey_of(positions, None) == Survey(positions, (0.0, 0.0, 0.0), None)
    full = survey_of(positions, "-0.4,0,1", "EPSG:25832")
    assert full == Survey(positions, (-0.4, 0.0, 1.0), "EPSG:25832")
    for antenna in ("1,2", "1,2,1e999", "here"):
        with pytest.raises(SettingsError, match="--antenna"):
            survey_of(positions, antenna)
    for half, where in ((("0,0,1", None), "--antenna"), ((None, "EPSG:25832"), "--crs")):
        with pytest.raises(SettingsError, match=where):
            survey_of(None, *half)
    assert read_start(None) == (None, None)
    assert read_start("7") == (None, 7)
    assert read_start("12.5,-3,90") == (StartPose(12.5, -3.0, 90.0), None)
    for text in ("1.5", "1,2", "1,2,3,4", "1,2,1e999", "there"):
        with pytest.raises(SettingsError, match="--start"):
            read_start(text)


def command_names() -> Iterator[tuple[str, ...]]:
    for name, command in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
        inside = getattr(command, "commands", None)
        yield from ((name, child) for child in inside) if inside else [(name,)]


@cache
def help_of(*words: str) -> str:
    done = CliRunner().invoke(app, [*words, "--help"], env={"COLUMNS": "200", "TERM": "dumb"})
    assert done.exit_code == 0, done.output
    return done.output


every_command = pytest.mark.parametrize("words", sorted(command_names()), ids=" ".join)


@every_command
def test_examples_are_of_that_command_and_use_options_that_it_has(words):
    examples = re.findall(r"^ {3}(recon .*\S) *$", help_of(*words), flags=re.MULTILINE)
    options = set(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", help_of(*words).split("Options")[-1]))
    assert examples
    for example in examples:
        assert example.startswith(" ".join(["recon", *words]))
        used = {word for word in shlex.split(example) if re.fullmatch(r"--?[a-z-]+", word)}
        assert used <= options, example


@every_command
def test_help_is_shown_whole_on_a_narrow_terminal(words):
    """Square brackets are markup to rich, which drops what it does not know."""
    command: Any = typer.main.get_command(app)
    for word in words:
        command = command.commands[word]
    squeezed = "".join(re.sub(r"[│\n]", " ", help_of(*words)).split())
    for parameter in command.params:
        text = getattr(parameter, "help", None) or ""
        assert "".join(text.split()) in squeezed, parameter.name
    lines = inspect.cleandoc(command.help or "").splitlines()[1:]
    assert max(map(len, lines)) <= 80 - 2  # two margins
    assert {"--json", "--quiet"} <= {name for one in command.params for name in one.opts}


def settings(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["settings", *arguments], env={"COLUMNS": "200"})


def entries(name: str | None = None) -> dict[str, SettingEntry]:
    return {entry.name: entry for group in list_settings(name) for entry in group.settings}


def test_every_setting_is_listed_once_with_what_it_does_and_a_default_that_can_be_set():
    named, pair = {*setting_names(ReconConfig)} - {"preset"}, load_config(defaults=PAIR_DEFAULTS)
    groups = {name for name in named if any(other.startswith(f"{name}.") for other in named)}
    assert {*entries()} == named - groups
    assert len(entries()) == sum(len(group.settings) for group in list_settings())
    assert all(group.purpose.endswith(".") for group in list_settings())
    for name, entry in entries().items():
        assert entry.description.endswith("."), name
        assert load_config(overrides=[f"{name}={entry.default}"]) == ReconConfig()
        assert load_config(None, [f"{name}={entry.default_pair}"], PAIR_DEFAULTS) == pair


def test_the_page_of_the_documentation_is_up_to_date():
    """If not: recon settings --markdown > docs/settings.md."""
    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    assert settings("--markdown").stdout == page == settings_page(list_settings())


def test_settings_are_selected_by_name_and_shown_with_units_and_other_defaults():
    assert all(name.startswith("matching.opencv.") for name in entries("matching.opencv"))
    assert [*entries("grid.min_height_m")] == ["grid.min_height_m"]
    assert {"fusion.voxel_m", "filters.voxel_m"} <= {*entries("voxel")}
    printed = json.loads(settings("grid", "--json").stdout)
    assert [one["name"] for one in printed["groups"][0]["settings"]] == [*entries("grid")]
    failed = settings("grid.min_heigt_m")
    assert failed.exit_code == 1
    assert failed.stderr.startswith("error: no setting is named 'grid.min_heigt_m'")
    assert "did you mean grid.min_height_m" in failed.stderr
    entry = entries("cloud.max_range_m")["cloud.max_range_m"]
    assert (entry.unit, entry.default_pair) == ("m", "none")
    assert entry.values.endswith("or none")
    assert entry.default != entry.default_pair
    assert "(pair: none)" in settings("cloud.max_range_m").stdout


def test_help_names_every_matcher_and_every_product():
    for words, names in ((("pair",), MATCHERS), (("export",), PRODUCTS)):
        shown = " ".join(re.sub(r"[│\n]", " ", help_of(*words)).split())
        assert [name for name in names if not re.search(rf"\b{re.escape(name)}\b", shown)] == []
