"""An interrupted run resumes and writes the same files as an uninterrupted one."""

from __future__ import annotations

import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from recon.commands.config import ReconConfig, load_config
from recon.commands.map import MapRun, run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import FormatError, OutputError, ReconError, SettingsError
from recon.map.drive.mapper import FrameResult
from recon.map.map import Map
from recon.map.store.records import Store
from recon.run.progress import SILENT, Silent
from recon.sources.registry import open_source
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.kitti import write_kitti

STREET = StreetScene(frames=15, width_px=192, height_px=72, focal_px=110.0, smooth_edges=False)
SETTINGS = ["checkpoints.every_frames=5", "submaps.length_m=4", "submaps.tile_m=25.6"]
FILES = [
    "trajectory_kitti.txt",
    "trajectory_tum.txt",
    "trajectory_map_base_tum.txt",
    "map/cloud.ply",
    "map/grid.pgm",
    "map/grid.yaml",
    "map/octomap.ot",
    "map/octomap.bt",
    "map/map.recon",
    "config.yaml",
]


class _Breaks(Silent):
    """A progress that aborts a run before a frame is reported."""

    def __init__(self, frame: int, error: BaseException) -> None:
        self.frame, self.error = frame, error

    def on_step(self, result: FrameResult) -> None:
        if result.index == self.frame:
            raise self.error


def _config(*more: str) -> ReconConfig:
    return load_config(None, [*SETTINGS, *more])


def _run(
    drive: Path, out: Path, observer: _Breaks | None = None, *, resume: bool = False
) -> MapRun:
    options = MapOptions(
        audit=False, out=out, mesh=False, progress=observer or SILENT, resume=resume
    )
    return run_map(open_source(drive), _config(), options)


def _content(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in FILES}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    write_kitti(SyntheticSource(STREET), folder)
    return folder


@pytest.fixture(scope="module")
def unbroken(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("unbroken")
    _run(drive, folder)
    return _content(folder)


@pytest.fixture(scope="module")
def broken_off(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that was interrupted at its thirteenth frame; it must not be changed."""
    folder = tmp_path_factory.mktemp("broken_off")
    with pytest.raises(KeyboardInterrupt):
        _run(drive, folder, _Breaks(12, KeyboardInterrupt()))
    return folder


@pytest.fixture
def begun(broken_off: Path, tmp_path: Path) -> Path:
    """A copy of that folder."""
    return Path(shutil.copytree(broken_off, tmp_path / "run"))


@pytest.mark.parametrize("frame", [0, 4, 8, 14])
def test_an_interrupted_run_goes_on_to_the_same_files(
    drive: Path, unbroken: dict[str, bytes], tmp_path: Path, frame: int
) -> None:
    with pytest.raises(KeyboardInterrupt, match="--resume"):
        _run(drive, tmp_path, _Breaks(frame, KeyboardInterrupt()))
    assert [path.name for path in tmp_path.iterdir()] == [".partial"]
    run = _run(drive, tmp_path, resume=True)
    assert _content(tmp_path) == unbroken
    assert run.summary["frames"] == STREET.frames
    assert not (tmp_path / ".partial").exists()


def test_a_run_that_is_broken_off_again_and_again_goes_on(
    drive: Path, unbroken: dict[str, bytes], tmp_path: Path
) -> None:
    for frame in (6, 7, 11):
        with pytest.raises(KeyboardInterrupt):
            _run(drive, tmp_path, _Breaks(frame, KeyboardInterrupt()), resume=frame != 6)
    _run(drive, tmp_path, resume=True)
    assert _content(tmp_path) == unbroken


def test_bad_input_leaves_nothing_to_resume(drive: Path, tmp_path: Path) -> None:
    with pytest.raises(FormatError):
        _run(drive, tmp_path / "run", _Breaks(12, FormatError("image is truncated")))
    assert list(tmp_path.iterdir()) == []


def test_other_settings_another_source_and_other_poses_are_refused(
    drive: Path, begun: Path, tmp_path: Path
) -> None:
    source = open_source(drive)
    options = MapOptions(audit=False, out=begun, mesh=False, resume=True)
    with pytest.raises(SettingsError, match=r"other settings.*fusion.voxel_m = 0.2, expected 0.1"):
        run_map(source, _config("fusion.voxel_m=0.2"), options)
    other = shutil.copytree(drive, tmp_path / "other")
    (other / "image_0" / "000007.png").write_bytes((drive / "image_0" / "000008.png").read_bytes())
    with pytest.raises(SettingsError, match="another source"):
        run_map(open_source(other), _config(), options)
    assert source.truth is not None
    known = MapOptions(
        audit=False,
        out=begun,
        mesh=False,
        resume=True,
        known_poses=source.truth.trajectory,
    )
    with pytest.raises(SettingsError, match="other poses"):
        run_map(source, _config(), known)
    assert (begun / ".partial").is_dir()


def test_without_an_unfinished_run_there_is_nothing_to_resume(drive: Path, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no unfinished run"):
        _run(drive, tmp_path / "run", resume=True)
    assert list(tmp_path.iterdir()) == []


def test_a_second_run_in_the_same_folder_is_refused_and_the_first_goes_on(
    drive: Path, unbroken: dict[str, bytes], tmp_path: Path
) -> None:
    refused = []

    class Meddles(_Breaks):
        def on_step(self, result: FrameResult) -> None:
            if result.index == 9:
                for resume in (False, True):
                    with pytest.raises(OutputError, match="another run") as told:
                        _run(drive, tmp_path, resume=resume)
                    refused.append(told.value)

    _run(drive, tmp_path, Meddles(0, KeyError()))
    assert len(refused) == 2
    assert _content(tmp_path) == unbroken


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
    assert _content(tmp_path) == unbroken


@pytest.mark.parametrize("damage", ["cut", "changed", "empty", "another"])
def test_a_damaged_map_is_one_line_and_stays(drive: Path, begun: Path, damage: str) -> None:
    path = begun / ".partial" / ".state" / "map.recon"
    content = bytearray(path.read_bytes())
    for place in range(100, len(content), 3000):
        content[place] ^= 0xFF
    damaged = {"cut": content[: len(content) // 2], "changed": content, "empty": b""}
    if damage == "another":
        with Map.create(path) as other:
            other.store.put("state", 0, {"a": 1})
            other.commit()
    else:
        path.write_bytes(damaged[damage])
    with pytest.raises(ReconError, match=r"without --resume") as caught:
        _run(drive, begun, resume=True)
    assert "\n" not in str(caught.value)
    assert str(begun) in str(caught.value)
    assert path.exists()


@pytest.mark.parametrize("kind", ["frames", "state", "submap_entry", "session", "axes"])
def test_a_missing_or_changed_record_is_one_line(drive: Path, begun: Path, kind: str) -> None:
    with Store.open(begun / ".partial" / ".state" / "map.recon") as store:
        first = store.keys(kind)[0]
        if kind in ("state", "axes", "session"):
            store.put(kind, first, {"a": 1})
        else:
            store.delete(kind, first)
        store.commit()
    with pytest.raises(ReconError, match=r"map.recon: .*without --resume") as caught:
        _run(drive, begun, resume=True)
    assert "\n" not in str(caught.value)


@contextmanager
def _largest_file(size: int) -> Iterator[None]:
    """A limit on the file size, which Python reports as an error."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
