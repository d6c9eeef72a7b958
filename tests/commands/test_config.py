"""What a run is asked for: settings from defaults, file and overrides; and what resuming keeps."""

from pathlib import Path
from typing import Any

import pytest
import yaml

import recon
from recon.commands.config import GROUPS, PAIR_DEFAULTS, ReconConfig, load_config
from recon.commands.map_options import MapOptions
from recon.core.errors import FormatError, OutputError, SettingsError
from recon.io.fields import write_yaml
from recon.map.map import Map
from recon.map.store.session import SessionInfo
from recon.run.directory import STARTED, state_folder

pytestmark = pytest.mark.portable


@pytest.mark.parametrize(
    ("command", "defaults", "overrides"),
    [
        ("map", {}, ["matching.window_px=9", "cloud.max_range_m=none", "memory.limit_mb=900"]),
        ("map", {}, ["matching.matcher=sgm", "street.seed=3", "mesh.max_distance_spacings=none"]),
        ("pair", PAIR_DEFAULTS, ["filters.statistical_neighbours=none", "filters.voxel_m=0.1"]),
        ("pair", PAIR_DEFAULTS, ["matching.matcher=onnx", "matching.onnx.model=a.onnx"]),
        ("calibrate", {}, ["calibration.model=fisheye", "calibration.working_m=3"]),
        ("paper", PAIR_DEFAULTS, ["matching.matcher=sad", "matching.window_px=9"]),
    ],
)
def test_a_dumped_configuration_loads_back_equal(tmp_path, command, defaults, overrides):
    config = load_config(None, overrides, defaults)
    write_yaml(tmp_path / "config.yaml", config.recorded(command))
    assert load_config(tmp_path / "config.yaml", defaults=defaults) == config


SETTINGS = ["matching.matcher=opencv-bm", "matching.opencv.pad=true", "fusion.voxel_m=0.2"]


@pytest.mark.parametrize("given", [
    {"matching.matcher": "opencv-bm", "matching.opencv.pad": True, "fusion.voxel_m": 0.2},
    {"matching": {"matcher": "opencv-bm", "opencv": {"pad": True}}, "fusion": {"voxel_m": 0.2}},
    {"matching": {"matcher": "opencv-bm", "opencv.pad": True}, "fusion.voxel_m": 0.2},
    {"matching": {"matcher": "opencv-bm"}, "matching.opencv": {"pad": True}, "fusion.voxel_m": 0.2},
])  # fmt: skip
def test_settings_are_dicts_with_dotted_or_nested_keys(tmp_path, given):
    expected = load_config(None, SETTINGS)
    for overrides in (given, [given], [SETTINGS[0], given]):
        assert load_config(None, overrides) == expected
    assert load_config(given) == load_config(defaults=given) == expected
    assert load_config(given, {"fusion.voxel_m": 0.3}) == load_config(
        expected, "fusion.voxel_m=0.3"
    )
    write_yaml(tmp_path / "config.yaml", given)
    assert load_config(tmp_path / "config.yaml") == expected


@pytest.mark.parametrize(("given", "why"), [
    ((None, {"matching.window": 9}), "unknown setting 'matching.window'.*window_px"),
    (({"matching": {"window": 9}},), "unknown setting 'matching.window'"),
    ((None, "window"), r"cannot read this setting \(got 'window', expected key=value\)"),
    ((None, {".".join("a" * 20): 1}), "cannot read this setting"),
    ((9,), r"not settings \(got int, expected a file, a mapping or a ReconConfig\)"),
])  # fmt: skip
def test_what_are_no_settings_is_one_line(given, why):
    with pytest.raises(SettingsError, match=why):
        load_config(*given)


def test_assigning_to_a_setting_says_what_to_use_and_that_works():
    config = load_config(None, PAIR_DEFAULTS)
    for group, name in ((config, "scene"), (config.matching, "window_px"), (config.mesh, "x")):
        with pytest.raises(
            SettingsError, match=rf"{name}: settings do not .*load_config\(config, "
        ):
            setattr(group, name, 9)
    changed = load_config(config, {"matching.window_px": 9})
    assert (changed.matching.window_px, changed.cloud) == (9, config.cloud)
    assert config.matching.window_px != 9
    # What follows from the size of the scene is not fixed by a change of something else.
    assert changed.at_scale(0.2) == load_config(
        None, ["matching.window_px=9"], PAIR_DEFAULTS
    ).at_scale(0.2)


def test_a_command_writes_only_what_determines_its_result(tmp_path):
    write_yaml(tmp_path / "config.yaml", load_config().recorded("map"))
    drive = (tmp_path / "config.yaml").read_text()
    assert drive.count("\n") < 100
    groups = yaml.safe_load(drive)
    assert {"source", "odometry", "grid", "mesh"} <= {*groups}
    assert not {"calibration", "capture", "audit", "paper", "street", "checkpoints"} & {*groups}
    assert {*groups["matching"]} == {"matcher", "min_disparity_px", "fill"}
    assert {*load_config().recorded("mesh")} == {"mesh"}
    again = load_config(overrides=["matching.keyframe_matcher=fine"]).recorded("map")
    assert {*again["matching"]} == {
        "matcher", "keyframe_matcher", "min_disparity_px", "fill"
    }  # fmt: skip


@pytest.mark.parametrize("command", GROUPS)
def test_the_groups_of_every_command_are_settings(command):
    assert {*GROUPS[command]} <= {*ReconConfig.model_fields}


def test_an_override_wins_for_its_key_and_the_file_is_not_blamed_for_a_wrong_one(tmp_path):
    (tmp_path / "c.yaml").write_text("mesh: {depth: 8}\nmatching: {window_px: 7}\n")
    changes = ["matching.window_px=9", "fusion.min_count=2", "fusion.min_count=5"]
    config = load_config(f"{tmp_path}/c.yaml", [*changes, "fusion.voxel_m=0.2"], PAIR_DEFAULTS)
    assert config.matching.window_px == 9
    assert (config.fusion.min_count, config.fusion.voxel_m, config.mesh.depth) == (5, 0.2, 8)
    assert config.cloud.max_range_m is None
    (tmp_path / "c.yaml").write_text("")
    assert load_config(tmp_path / "c.yaml") == ReconConfig()
    (tmp_path / "good.yaml").write_text("matching:\n  matcher: sgm\n")
    with pytest.raises(SettingsError, match=r"^setting 'matching\.window_px': ") as refused:
        load_config(tmp_path / "good.yaml", ["matching.window_px=8"])
    assert "good.yaml" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fusion: {voxels_m: 0.1}", r"unknown setting 'fusion\.voxels_m'"),
        ("fusion: {voxel_m: -1}", r"setting 'fusion\.voxel_m': .*greater than or equal.*got -1"),
        ("fusion: [1", "not a YAML file"),
        ("- 1\n- 2", "not a mapping"),
    ],
)
def test_a_wrong_file_is_refused_by_name(tmp_path, text, message):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=message) as caught:
        load_config(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    path.unlink()
    with pytest.raises(SettingsError, match=r"c\.yaml: file does not exist"):
        load_config(path)


@pytest.mark.parametrize(
    ("text", "changes"),
    [
        ("fusion.min_count=2,fusion.voxel_m=0.2", {"fusion.min_count": 2, "fusion.voxel_m": 0.2}),
        (
            "audit.baseline_m=[0.1,2], matching.matcher=sgm",
            {"audit.baseline_m": (0.1, 2), "matching.matcher": "sgm"},
        ),
        ("source.left=a,b=c.png", {"source.left": "a,b=c.png"}),
    ],
)
def test_several_settings_stand_in_one_text_with_commas(text, changes):
    assert load_config(overrides=[text]) == load_config(overrides=[changes])


@pytest.mark.parametrize("text", ["fusion.voxel_m", "=3", "fusion.voxel_m=[1"])
def test_an_override_that_cannot_be_read_is_refused(text):
    with pytest.raises(SettingsError, match="--set"):
        load_config(overrides=[text])


def test_a_map_is_made_and_opened_by_its_name(tmp_path):
    with recon.Map.create(f"{tmp_path}/map/map.recon") as map_:
        map_.commit()
    for name in (f"{tmp_path}/map/map.recon", str(tmp_path)):
        with recon.Map.open(name) as map_:
            assert map_.sessions == []


def test_a_folder_that_is_no_run_is_named_whatever_the_type(tmp_path):
    for make in (recon.run_export, recon.run_occupancy):
        for folder in (tmp_path, str(tmp_path)):
            with pytest.raises(FormatError, match="does not contain a finished run"):
                make(folder)
    source = recon.SyntheticSource()
    with pytest.raises(FormatError, match=r"folder has no map \(expected a map/map\.recon"):
        recon.run_localize(source, str(tmp_path), options=recon.MapOptions(out=f"{tmp_path}/out"))


RAN = load_config(None, ["fusion.voxel_m=0.2", "memory.limit_mb=900"])


@pytest.fixture
def begin(tmp_path):
    """Begin a run: its folder, with an unfinished map that keeps what it was asked for."""

    def begun(config: dict[str, Any] | None = None, **asked: Any) -> Path:
        options = MapOptions(source=tmp_path / "drive", kind="kitti", **asked)
        identity = {"config": RAN.model_dump(mode="json") if config is None else config}
        start = {"identity": identity, "arguments": options.arguments}
        path = state_folder(tmp_path / "run") / STARTED
        path.parent.mkdir(parents=True)
        with Map.create(path) as map_:
            map_.begin(SessionInfo("drive", "a drive", 3, {}, {}, start))
            map_.commit()
        return tmp_path / "run"

    return begun


def test_what_is_left_open_is_as_the_run_was_asked_for(begin, tmp_path):
    (tmp_path / "prior.txt").touch()
    run = begin(poses_file=tmp_path / "p.txt", prior_from=str(tmp_path / "prior.txt"), mesh=False)
    options, settings = MapOptions(threads=2).resumed(run, None, [])
    assert settings == RAN
    assert (options.resume, options.out, options.threads) == (True, run, 2)
    assert (options.source, options.kind) == (str(tmp_path / "drive"), "kitti")
    assert (options.poses_file, options.mesh) == (str(tmp_path / "p.txt"), False)
    assert options.prior_from == str(tmp_path / "prior.txt")
    other, _ = MapOptions(source="moved", kind="tum", prior_from="/odom").resumed(run, None, [])
    assert (other.source, other.kind, other.prior_from) == ("moved", "tum", "/odom")


def test_settings_must_be_those_of_the_run_but_for_the_memory(begin):
    run = begin()
    for same in ([], ["fusion.voxel_m=0.2"], [{"fusion.voxel_m": 0.2}]):
        assert MapOptions().resumed(run, None, same)[1] == RAN
    _, settings = MapOptions().resumed(run, None, [{"memory.limit_mb": 700}])
    assert (settings.memory.limit_mb, settings.fusion.voxel_m) == (700, 0.2)
    with pytest.raises(SettingsError, match=r"other settings.*voxel_m = 0.1, expected 0.2"):
        MapOptions().resumed(run, None, ["fusion.voxel_m=0.1"])
    with pytest.raises(SettingsError, match="started with a mesh"):
        MapOptions(mesh=False).resumed(run, None, [])


@pytest.mark.parametrize("config", [{"grid": {"free_height_m": 0.5}}, {"no": 1}])
def test_settings_that_there_are_not_are_refused_by_the_name_of_the_run(begin, config):
    run = begin(config)
    with pytest.raises(SettingsError, match=str(run)):
        MapOptions().resumed(run, None, [])


def test_where_nothing_can_be_opened_or_resumed_it_is_said_why(tmp_path):
    assert MapOptions().arguments == {}
    with pytest.raises(SettingsError, match="name SOURCE"):
        MapOptions().open(ReconConfig())
    with pytest.raises(OutputError, match=r"no unfinished run.*start it without --resume"):
        MapOptions().resumed(tmp_path, None, [])
    (tmp_path / "run.json").touch()
    with pytest.raises(OutputError, match="it is finished"):
        MapOptions().resumed(tmp_path, None, [])
    path = state_folder(tmp_path) / STARTED
    path.parent.mkdir(parents=True)
    path.write_bytes(b"no map")
    with pytest.raises(FormatError, match="cannot be read"):
        MapOptions().resumed(tmp_path, None, [])
