"""Presets, and the settings that they change."""

import pytest
import yaml

import recon
from recon.commands.config import (
    PAIR_DEFAULTS,
    check_changes,
    load_config,
    preset_text,
)
from recon.core.errors import SettingsError
from recon.io.fields import write_yaml
from tests.hostile.refusals import assert_refused, run

PRESETS = ["fast", "robot", "survey", "room", "small"]


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_what_its_text_says_and_says_for_whom_it_is(name, tmp_path):
    (tmp_path / "c.yaml").write_text(text := preset_text(name))
    assert "# For " in text
    assert "# Costs " in text
    for defaults in ({}, PAIR_DEFAULTS):
        config = recon.load_config(defaults=defaults, preset=name)
        copied = load_config(tmp_path / "c.yaml", defaults=defaults)
        assert config == copied.model_copy(update={"preset": name})
        assert config != load_config(defaults=defaults).model_copy(update={"preset": name})


def test_defaults_come_before_a_preset_and_a_file_and_options_after_it(tmp_path):
    file = {"grid.max_height_m": 3.0, "robot.width_m": 0.7}
    write_yaml(tmp_path / "c.yaml", file)
    config = load_config(
        tmp_path / "c.yaml", ["robot.width_m=0.9"], {"grid.min_height_m": 0.5}, preset="robot"
    )
    assert (config.grid.min_height_m, config.grid.max_height_m) == (0.2, 3.0)
    assert (config.robot.width_m, config.robot.wheel_radius_m) == (0.9, 0.1)
    # A file that was written by such a run gives the same, and may name the preset alone.
    write_yaml(tmp_path / "config.yaml", config.recorded("map"))
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["preset"] == "robot"
    assert load_config(tmp_path / "config.yaml") == config
    assert load_config({"preset": "robot", **file}, ["robot.width_m=0.9"]) == config
    assert load_config(config, ["robot.width_m=1"]).preset == "robot"


def test_an_unknown_preset_lists_those_there_are(tmp_path):
    ended = run("demo", "--preset", "fats", "--out", tmp_path / "out")
    assert_refused(ended, "unknown preset", "fast, robot, survey, room, small", "mean fast?")
    with pytest.raises(SettingsError, match=r"not one of the settings.*--preset NAME"):
        load_config(None, ["preset=fast"])


@pytest.mark.parametrize(("old", "words"), [
    ("matching.sad.ndisp", "mean matching.ndisp?"),
    ("odometry.prior.sigma_share", "odometry.prior.sigma_ratio?"),
    ("mesh.map_surface", "mean mesh.surface?"),
    ("capture.side_by_side", "mean source.side_by_side?"),
    ("matching.sgm.p1", "`recon settings` lists them all"),
])  # fmt: skip
def test_a_name_from_before_1_0_is_an_unknown_setting_like_any_other(old, words, tmp_path):
    assert_refused(run("map", tmp_path, "--set", f"{old}=3"), f"unknown setting '{old}'", words)


def test_what_a_preset_says_of_a_finished_drive_is_no_change_of_it_and_a_wish_is():
    ran = load_config(None, ["fusion.min_count=2"])
    known = ran.model_dump(mode="json", exclude={"preset"})
    chosen = load_config(None, (), known, preset="fast")
    check_changes(ran, chosen, ("grid",))
    assert chosen.source.stride == 2
    with pytest.raises(SettingsError, match=r"not mapped again \(got source"):
        check_changes(ran, load_config(chosen, {"source.stride": 3}), ("grid",))
