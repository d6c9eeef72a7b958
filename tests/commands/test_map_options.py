"""What a run was asked for is kept in its unfinished map, completed from it and compared."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from recon.commands.config import ReconConfig, load_config
from recon.commands.map_options import MapOptions
from recon.core.errors import FormatError, OutputError, ReconError, SettingsError
from recon.map.map import Map
from recon.map.store.session import SessionInfo
from recon.run.directory import STARTED, state_folder

Begin = Callable[..., Path]
RAN = load_config(None, ["fusion.voxel_m=0.2", "memory.limit_mb=900"])


@pytest.fixture
def begin(tmp_path: Path) -> Begin:
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


def test_what_is_left_open_is_as_the_run_was_asked_for(begin: Begin, tmp_path: Path) -> None:
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


def test_settings_must_be_those_of_the_run_but_for_the_memory(begin: Begin) -> None:
    run = begin()
    for same in ([], ["fusion.voxel_m=0.2"], [{"fusion.voxel_m": 0.2}]):
        assert MapOptions().resumed(run, None, same)[1] == RAN
    _, settings = MapOptions().resumed(run, None, [{"memory.limit_mb": 700}])
    assert settings.memory.limit_mb == 700
    assert settings.fusion.voxel_m == 0.2
    with pytest.raises(SettingsError, match=r"other settings.*voxel_m = 0.1, expected 0.2"):
        MapOptions().resumed(run, None, ["fusion.voxel_m=0.1"])
    with pytest.raises(SettingsError, match="started with a mesh"):
        MapOptions(mesh=False).resumed(run, None, [])


def test_a_run_of_an_earlier_version_has_settings_that_are_fixed_now(begin: Begin) -> None:
    run = begin({"grid": {"free_height_m": 0.8, "max_height_m": 3.0}, "audit": {"frames": 300}})
    _, settings = MapOptions().resumed(run, None, [])
    assert settings == load_config(None, ["grid.max_height_m=3"])


@pytest.mark.parametrize(
    ("config", "error"),
    [({"grid": {"free_height_m": 0.5}}, SettingsError), ({"no": 1}, SettingsError)],
)
def test_settings_that_there_are_not_are_refused_by_the_name_of_the_run(
    begin: Begin, config: dict[str, Any], error: type[ReconError]
) -> None:
    run = begin(config)
    with pytest.raises(error, match=str(run)):
        MapOptions().resumed(run, None, [])


def test_where_nothing_can_be_resumed_it_is_said_why(tmp_path: Path) -> None:
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


def test_without_a_source_there_is_nothing_to_open_and_nothing_to_keep() -> None:
    assert MapOptions().arguments == {}
    with pytest.raises(SettingsError, match="name SOURCE"):
        MapOptions().open(ReconConfig())
