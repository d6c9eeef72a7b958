"""Presets, and settings whose names are others now."""

import warnings
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
import yaml

import recon
from recon.commands.config import (
    PAIR_DEFAULTS,
    ReconConfig,
    check_changes,
    load_config,
    preset_text,
)
from recon.core.errors import SettingsError
from recon.core.renamed import CONSTANTS, JOINED, RENAMED, current_names, with_former_keys
from recon.core.settings import setting_names
from recon.io.fields import write_yaml
from recon.map.settings import DriveSettings
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


OLD: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "a range": ({"matching.sad.ndisp": 64}, {"matching.ndisp": 64}),
    "a window": ({"matching.opencv.block_px": 15}, {"matching.window_px": 15}),
    "defaults": ({"matching": {"sad": {"window_px": 11, "uniqueness_percent": 2}}}, {}),
    "a surface": ({"mesh.map_surface": "poisson"}, {"mesh.surface": "poisson"}),
    "surfaces": ({"mesh": {"pair_surface": "grid", "map_surface": "voxels"}}, {}),
    "a reach in a room": ({"scene.scale": 0.2, "ground.reach_m": 5.0}, {"scene.scale": 0.2}),
    "a reach": ({"ground.reach_m": 30.0}, {"occupancy.max_range_m": 30.0}),
    "a constant": ({"grid.min_blob_cells": 3, "mesh.max_depth": 10}, {}),
    "of another matcher": (
        {"matching": {"matcher": "fine", "fine": {"ndisp": 64}, "sad": {"ndisp": 32}}},
        {"matching": {"matcher": "fine", "ndisp": 64}},
    ),
    "a size": ({"capture": {"width_px": 640, "height_px": 480}}, {"capture.size_px": [640, 480]}),
    "no size": ({"matching.onnx": {"width_px": None, "height_px": None}}, {}),
    "a rig in a room": (
        {"street": {"path": "room", "baseline_m": 0.12, "pitch_deg": 8.0}}, {"street.path": "room"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", OLD)
def test_old_names_are_read_with_one_line_that_names_the_new_ones(case):
    old, new = OLD[case]
    with pytest.warns(FutureWarning, match=r"since 1\.0") as told:
        config = load_config(old)
    assert len(told) == 1
    assert config == load_config(new)


@pytest.mark.parametrize(("given", "words"), [
    ({"matching.sgm.p1": 20}, r"sgm\.p1' is a constant since 1\.0 \(got 20, expected 16"),
    ({"matching.sad.fill": False, "matching.fine.fill": True}, r"another value.*ing\.fill alone"),
])  # fmt: skip
def test_old_values_that_there_are_no_more_are_refused_in_one_line(given, words):
    with pytest.raises(SettingsError, match=words) as refused:
        load_config(given)
    assert "\n" not in str(refused.value)


def test_of_runs_that_have_the_old_and_the_new_name_the_new_one_counts_and_it_is_said():
    old = {"robot.clearance_m": 1.5, "grid.max_height_m": 2.0, "ground.reach_m": 30}
    old |= {"occupancy.max_range_m": 25, "matching.sad.ndisp": None, "cloud.stride": 1}
    said = r"25 is used, not 30; .* 2\.0 is used, not 1\.5; .*and 1 more name"
    with pytest.warns(FutureWarning, match=said):
        config = load_config(old)
    assert (config.grid.max_height_m, config.occupancy.max_range_m) == (2.0, 25.0)


@pytest.mark.parametrize(("file", "options", "new"), [
    ({"matching.window_px": 9}, ["matching.sad.window_px=11"], {"matching.window_px": 11}),
    ({"mesh.surface": "poisson"}, ["mesh.map_surface=voxels"], {"mesh.surface": "grid"}),
    ({}, ["capture.width_px=640", "capture.height_px=480"], {"capture.size_px": [640, 480]}),
    ({"street.path": "room"}, ["street.baseline_m=0.12"], {"street.path": "room"}),
    ({"scene.scale": 0.2}, ["odometry.max_range_m=6"], {"scene.scale": 0.2}),
])  # fmt: skip
def test_old_names_in_options_change_what_there_is_even_to_what_is_usual(file, options, new):
    with pytest.warns(FutureWarning, match=r"since 1\.0"):
        config = load_config(file, options)
    assert config == load_config(new)


@pytest.mark.parametrize("given", [
    {"preset": ["fast"]}, {"preset": {"a": 1}}, {"capture.width_px": [1]},
    {"matching.sgm.p1": 10**400},
])  # fmt: skip
@pytest.mark.filterwarnings("ignore:.*since 1.0:FutureWarning")
def test_nonsense_by_names_of_any_age_is_refused(given):
    with pytest.raises(SettingsError):
        load_config(given)


def test_only_the_segments_of_a_drive_have_a_former_name():
    rows = [{"segments": 20}]
    found = with_former_keys({"segments": [], "trajectory": {"segments": 20, "by_length": rows}})
    assert found == {
        "segments": [], "drive_sessions": [], "trajectory": {"segments": 20, "by_length": rows},
    }  # fmt: skip


@pytest.mark.parametrize("group", ["rig", "rig_by_motion"])
def test_a_rig_has_its_former_keys_wherever_it_stands(group):
    found = with_former_keys({group: {"epipolar_error_px": 0.5, "right_time_offset": {}}})
    assert found[group].items() >= {"rows_px": 0.5, "right_late": {}}.items()


def test_every_new_name_is_one_and_no_old_name_is():
    names = {*setting_names(ReconConfig)}
    assert {one.to for one in RENAMED.values()} | {*JOINED} <= names
    assert not {*RENAMED, *CONSTANTS, *chain(*JOINED.values())} & names


def test_the_settings_that_an_old_map_keeps_are_read_without_a_word():
    # As recon wrote them into map.recon before 1.0; what is the usual way is left out here.
    kept = {
        "matching": {"matcher": "sad", "sad": {"ndisp": 48, "window_px": 11, "fill": False},
                     "sgm": {"p1": 16.0, "p2": 50.0, "fill": False}, "onnx": {"time_limit_s": 600}},
        "ground": {"reach_m": 25.0, "camera_height_m": None}, "cloud": {"stride": 1},
        "robot": {"clearance_m": 2.0, "width_m": 0.6}, "grid": {"min_blob_cells": 3},
        "odometry": {"prior": {"max_gap_s": 1.0}}, "occupancy": {"max_range_m": 25.0},
    }  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        settings = DriveSettings.parse(kept)
    assert settings == DriveSettings.parse({"matching": {"ndisp": 48}})
    again, notes = current_names(settings.model_dump(mode="json"))
    assert (again, notes) == (settings.model_dump(mode="json"), [])


def test_a_command_shows_the_new_name_once(tmp_path: Path):
    ended = run("map", tmp_path / "none", "--set", "matching.sad.ndisp=64,matching.sgm.p1=16")
    (said,) = [line for line in ended.err.splitlines() if line.startswith("warning: ")]
    assert said.endswith(
        "matching.sad.ndisp is matching.ndisp since 1.0; "
        "matching.sgm.p1 is a constant since 1.0: remove it"
    )


def test_what_a_preset_says_of_a_finished_drive_is_no_change_of_it_and_a_wish_is():
    ran = load_config(None, ["fusion.min_count=2"])
    known = ran.model_dump(mode="json", exclude={"preset"})
    chosen = load_config(None, (), known, preset="fast")
    check_changes(ran, chosen, ("grid",))
    assert chosen.source.stride == 2
    with pytest.raises(SettingsError, match=r"not mapped again \(got source"):
        check_changes(ran, load_config(chosen, {"source.stride": 3}), ("grid",))
