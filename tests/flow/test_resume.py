"""An interrupted run resumes and writes the same files as an uninterrupted one."""

from __future__ import annotations

import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from recon.commands.config import ReconConfig, load_config
from recon.commands.map import MapRun, run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import FormatError, OutputError, ReconError, SettingsError
from recon.map.drive.mapper import FrameResult
from recon.map.map import Map
from recon.map.store.records import Store
from recon.sources.registry import open_source
from tests.flow.runs import STATE, Breaks, content
from tests.scenery.kitti import street_drive

FRAMES = 15


def _config(*more: str) -> ReconConfig:
    settings = ["checkpoints.every_frames=5", "submaps.length_m=4", "submaps.tile_m=25.6"]
    return load_config(None, [*settings, *more])


def _run(
    drive: Path, out: Path, progress: Breaks | None = None, *settings: str, **more: Any
) -> MapRun:
    options = MapOptions(audit=False, out=out, mesh=False, progress=progress or Breaks(), **more)
    return run_map(open_source(drive), _config(*settings), options)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return street_drive(tmp_path_factory.mktemp("drive"), FRAMES, 192)


@pytest.fixture(scope="module")
def unbroken(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What a run in one thread writes."""
    folder = tmp_path_factory.mktemp("unbroken")
    _run(drive, folder, threads=1)
    return content(folder)


@pytest.fixture(scope="module")
def broken_off(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that was interrupted at its thirteenth frame; it must not be changed."""
    folder = tmp_path_factory.mktemp("broken_off")
    with pytest.raises(KeyboardInterrupt):
        _run(drive, folder, Breaks(12))
    return folder


@pytest.fixture
def begun(broken_off: Path, tmp_path: Path) -> Path:
    """A copy of that folder."""
    return Path(shutil.copytree(broken_off, tmp_path / "run"))


@pytest.mark.parametrize("frames", [[0], [4], [14], [6, 7, 11]])
def test_an_interrupted_run_goes_on_to_the_same_files_in_any_number_of_threads(
    drive: Path, unbroken: dict[str, bytes], tmp_path: Path, frames: list[int]
) -> None:
    for number, frame in enumerate(frames):
        with pytest.raises(KeyboardInterrupt, match="--resume"):
            _run(drive, tmp_path, Breaks(frame), resume=number > 0)
        assert [path.name for path in tmp_path.iterdir()] == [".partial"]
    run = _run(drive, tmp_path, resume=True, threads=2)
    assert content(tmp_path) == unbroken
    assert run.summary["frames"] == FRAMES
    assert not (tmp_path / ".partial").exists()


def test_what_cannot_be_resumed_leaves_nothing(drive: Path, tmp_path: Path) -> None:
    with pytest.raises(FormatError):
        _run(drive, tmp_path / "run", Breaks(12, FormatError("image is truncated")))
    with pytest.raises(OutputError, match="no unfinished run"):
        _run(drive, tmp_path / "run", resume=True)
    assert list(tmp_path.iterdir()) == []


def test_other_settings_another_source_and_other_poses_are_refused(
    drive: Path, begun: Path, tmp_path: Path
) -> None:
    with pytest.raises(SettingsError, match=r"other settings.*fusion.voxel_m = 0.2, expected 0.1"):
        _run(drive, begun, None, "fusion.voxel_m=0.2", resume=True)
    other = shutil.copytree(drive, tmp_path / "other")
    (other / "image_0" / "000007.png").write_bytes((drive / "image_0" / "000008.png").read_bytes())
    with pytest.raises(SettingsError, match="another source"):
        _run(other, begun, resume=True)
    truth = open_source(drive).truth
    assert truth is not None
    with pytest.raises(SettingsError, match="other poses"):
        _run(drive, begun, resume=True, known_poses=truth.trajectory)
    assert (begun / STATE).is_file()


def test_a_second_run_in_the_same_folder_is_refused_and_the_first_goes_on(
    drive: Path, unbroken: dict[str, bytes], tmp_path: Path
) -> None:
    refused = []

    class Meddles(Breaks):
        def on_step(self, result: FrameResult) -> None:
            if result.index == 9:
                for resume in (False, True):
                    with pytest.raises(OutputError, match="another run") as told:
                        _run(drive, tmp_path, resume=resume)
                    refused.append(told.value)

    _run(drive, tmp_path, Meddles())
    assert len(refused) == 2
    assert content(tmp_path) == unbroken


def test_a_full_disk_is_one_line_and_the_run_goes_on_when_there_is_room(
    drive: Path, unbroken: dict[str, bytes], tmp_path: Path
) -> None:
    with (
        _largest_file(150_000),
        pytest.raises(OutputError, match=r"(cannot write|disk is full).*--resume") as told,
    ):
        _run(drive, tmp_path)
    assert "\n" not in str(told.value)
    _run(drive, tmp_path, resume=True)
    assert content(tmp_path) == unbroken


@contextmanager
def _largest_file(size: int) -> Iterator[None]:
    """A limit on the file size, which Python reports as an error."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize(
    "damage",
    ["cut", "changed", "empty", "another", "frames", "state", "submap_entry", "session", "axes"],
)
def test_a_damaged_map_is_one_line_and_stays(drive: Path, begun: Path, damage: str) -> None:
    path = begun / STATE
    content = bytearray(path.read_bytes())
    for place in range(100, len(content), 3000):
        content[place] ^= 0xFF
    damaged = {"cut": content[: len(content) // 2], "changed": content, "empty": b""}
    if damage in damaged:
        path.write_bytes(damaged[damage])
    elif damage == "another":
        with Map.create(path) as other:
            other.store.put("state", 0, {"a": 1})
            other.commit()
    else:
        with Store.open(path) as store:
            first = store.keys(damage)[0]
            if damage in ("frames", "submap_entry"):
                store.delete(damage, first)
            else:
                store.put(damage, first, {"a": 1})
            store.commit()
    with pytest.raises(ReconError, match=r"without --resume") as caught:
        _run(drive, begun, resume=True)
    assert "\n" not in str(caught.value)
    assert str(begun) in str(caught.value)
    assert path.exists()
