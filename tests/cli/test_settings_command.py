"""`recon settings` lists every setting, and docs/settings.md is what it prints."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from recon.cli import app
from recon.commands.config import (
    PAIR_DEFAULTS,
    ReconConfig,
    SettingEntry,
    list_settings,
    load_config,
    settings_page,
)
from recon.core.settings import setting_names

PAGE = Path(__file__).parents[2] / "docs" / "settings.md"


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["settings", *arguments], env={"COLUMNS": "200"})


def entries(name: str | None = None) -> dict[str, SettingEntry]:
    return {entry.name: entry for group in list_settings(name) for entry in group.settings}


def test_every_setting_is_listed_once() -> None:
    named = {*setting_names(ReconConfig)}
    groups = {name for name in named if any(other.startswith(f"{name}.") for other in named)}
    assert {*entries()} == named - groups
    assert len(entries()) == sum(len(group.settings) for group in list_settings())


@pytest.mark.parametrize("name", sorted(entries()))
def test_every_setting_says_what_it_does_and_its_default_can_be_set(name: str) -> None:
    entry = entries()[name]
    assert entry.description.endswith("."), name
    assert load_config(overrides=[f"{name}={entry.default}"]) == ReconConfig()
    assert load_config(
        overrides=[f"{name}={entry.default_pair}"], defaults=PAIR_DEFAULTS
    ) == load_config(defaults=PAIR_DEFAULTS)


def test_every_group_says_what_it_is_about() -> None:
    assert all(group.purpose.endswith(".") for group in list_settings())


def test_the_page_of_the_documentation_is_up_to_date() -> None:
    """If not: recon settings --markdown > docs/settings.md."""
    assert PAGE.read_text(encoding="utf-8") == settings_page(list_settings())
    assert run("--markdown").stdout == PAGE.read_text(encoding="utf-8")


def test_a_group_a_setting_or_a_part_of_a_name_selects() -> None:
    assert all(name.startswith("matching.sgm.") for name in entries("matching.sgm"))
    assert [*entries("grid.min_height_m")] == ["grid.min_height_m"]
    assert {"fusion.voxel_m", "filters.voxel_m"} <= {*entries("voxel")}


def test_unit_values_and_other_defaults_of_a_pair_are_shown() -> None:
    entry = entries("cloud.max_range_m")["cloud.max_range_m"]
    assert (entry.unit, entry.default_pair) == ("m", "none")
    assert entry.values.endswith("or none")
    assert entry.default != entry.default_pair
    assert "(pair: none)" in run("cloud.max_range_m").stdout


def test_json_gives_the_same_entries() -> None:
    printed = json.loads(run("grid", "--json").stdout)
    assert [one["name"] for one in printed["groups"][0]["settings"]] == [*entries("grid")]


def test_an_unknown_name_is_answered_with_one_that_is_meant() -> None:
    failed = run("grid.min_heigt_m")
    assert failed.exit_code == 1
    assert failed.stderr.startswith("error: no setting is named 'grid.min_heigt_m'")
    assert "did you mean grid.min_height_m" in failed.stderr
