"""Settings come from defaults, file and overrides, in that order; unknown ones are errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

import recon
from recon.commands.config import GROUPS, PAIR_DEFAULTS, ReconConfig, load_config
from recon.core.errors import FormatError, SettingsError
from recon.io.fields import write_yaml
from recon.run.run import Run


@pytest.mark.parametrize(
    ("command", "defaults", "overrides"),
    [
        ("map", {}, ["matching.sad.window_px=9", "cloud.max_range_m=none", "memory.limit_mb=900"]),
        ("map", {}, ["matching.matcher=sgm", "street.seed=3", "mesh.max_distance_spacings=none"]),
        ("pair", PAIR_DEFAULTS, ["filters.statistical_neighbours=none", "filters.voxel_m=0.1"]),
        ("pair", PAIR_DEFAULTS, ["matching.matcher=onnx", "matching.onnx.model=a.onnx"]),
        ("calibrate", {}, ["calibration.model=fisheye", "calibration.working_m=3"]),
        ("paper", PAIR_DEFAULTS, ["paper.as_printed=true"]),
    ],
)
def test_a_dumped_configuration_loads_back_equal(
    tmp_path: Path, command: str, defaults: dict[str, Any], overrides: list[str]
) -> None:
    config = load_config(None, overrides, defaults)
    write_yaml(tmp_path / "config.yaml", config.recorded(command))
    assert load_config(tmp_path / "config.yaml", defaults=defaults) == config


def test_a_command_writes_only_what_determines_its_result(tmp_path: Path) -> None:
    write_yaml(tmp_path / "config.yaml", load_config().recorded("map"))
    drive = (tmp_path / "config.yaml").read_text()
    assert drive.count("\n") < 100
    groups = yaml.safe_load(drive)
    assert {"source", "odometry", "grid", "mesh"} <= {*groups}
    assert not {"calibration", "capture", "audit", "paper", "street", "checkpoints"} & {*groups}
    assert {*groups["matching"]} == {"matcher", "sad"}
    assert {*load_config().recorded("mesh")} == {"mesh"}


@pytest.mark.parametrize("command", GROUPS)
def test_the_groups_of_every_command_are_settings(command: str) -> None:
    assert {*GROUPS[command]} <= {*ReconConfig.model_fields}


def test_overrides_win_over_the_file_and_the_file_over_defaults(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("mesh: {max_depth: 8}\nmatching: {sad: {window_px: 7}}\n")
    config = load_config(tmp_path / "c.yaml", ["matching.sad.window_px=9"], PAIR_DEFAULTS)
    assert config.matching.sad.window_px == 9
    assert config.mesh.max_depth == 8
    assert config.cloud.max_range_m is None


def test_the_last_override_of_a_key_wins() -> None:
    config = load_config(overrides=["fusion.min_count=2", "fusion.min_count=5"])
    assert config.fusion.min_count == 5


def test_overrides_of_two_keys_of_one_stage_both_count() -> None:
    config = load_config(overrides=["fusion.min_count=2", "fusion.voxel_m=0.2"])
    assert (config.fusion.min_count, config.fusion.voxel_m) == (2, 0.2)


def test_an_empty_file_gives_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("")
    assert load_config(tmp_path / "c.yaml") == ReconConfig()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fusion: {voxels_m: 0.1}", r"unknown setting 'fusion\.voxels_m'"),
        ("fusion: {voxel_m: -1}", r"setting 'fusion\.voxel_m': .*greater than or equal.*got -1"),
        ("fusion: [1", "not a YAML file"),
        ("- 1\n- 2", "not a mapping"),
    ],
)
def test_a_wrong_file_is_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=message) as caught:
        load_config(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_file_is_not_blamed_for_a_wrong_override(tmp_path: Path) -> None:
    (tmp_path / "good.yaml").write_text("matching:\n  matcher: sgm\n")
    with pytest.raises(SettingsError, match=r"^setting 'matching\.sad\.window_px': ") as refused:
        load_config(tmp_path / "good.yaml", ["matching.sad.window_px=8"])
    assert "good.yaml" not in str(refused.value)


def test_a_missing_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"none\.yaml: file does not exist"):
        load_config(tmp_path / "none.yaml")


@pytest.mark.parametrize("text", ["fusion.voxel_m", "=3", "fusion.voxel_m=[1"])
def test_an_override_that_cannot_be_read_is_refused(text: str) -> None:
    with pytest.raises(SettingsError, match="--set"):
        load_config(overrides=[text])


def test_a_map_is_made_and_opened_by_its_name(tmp_path: Path) -> None:
    with recon.Map.create(f"{tmp_path}/map/map.recon") as map_:
        map_.commit()
    for name in (f"{tmp_path}/map/map.recon", str(tmp_path)):
        with recon.Map.open(name) as map_:
            assert map_.sessions == []


def test_settings_are_read_by_the_name_of_their_file(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("grid: {max_height_m: 3}")
    assert recon.load_config(f"{tmp_path}/robot.yaml").grid.max_height_m == 3


def test_a_run_writes_to_a_folder_by_its_name(tmp_path: Path) -> None:
    with Run("pair", f"{tmp_path}/out") as run:
        run.path("a.txt").write_text("a")
    assert (tmp_path / "out/a.txt").is_file()


def test_a_folder_that_is_no_run_is_named_whatever_the_type(tmp_path: Path) -> None:
    for make in (recon.run_export, recon.run_occupancy):
        for folder in (tmp_path, str(tmp_path)):
            with pytest.raises(FormatError, match="does not contain a finished run"):
                make(folder)
    source = recon.SyntheticSource()
    with pytest.raises(FormatError, match=r"folder has no map \(expected a map/map\.recon"):
        recon.run_localize(source, str(tmp_path), options=recon.MapOptions(out=f"{tmp_path}/out"))
