"""An interrupted run resumes and writes the same files as an uninterrupted one."""

import shutil

import pytest

from recon.commands.config import load_config
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import FormatError, OutputError, SettingsError
from recon.core.progress import showing
from recon.map.drive.mapper import FrameResult
from recon.sources.registry import open_source
from tests.flow.runs import STATE, Breaks, content
from tests.scenery.kitti import street_drive

FRAMES = 15


def _run(drive, out, progress=None, *settings, **more):
    usual = ("checkpoints.every_frames=5", "submaps.length_m=4", "submaps.tile_m=25.6")
    options = MapOptions(audit=False, out=out, mesh=False, **more)
    with showing(progress or Breaks()):
        return run_map(open_source(drive), load_config(None, [*usual, *settings]), options)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return street_drive(tmp_path_factory.mktemp("drive"), FRAMES, 192)


@pytest.fixture(scope="module")
def unbroken(drive, tmp_path_factory):
    """What a run in one thread writes."""
    folder = tmp_path_factory.mktemp("unbroken")
    _run(drive, folder, threads=1)
    return content(folder)


@pytest.mark.parametrize("frames", [[0], [4], [14], [6, 7, 11]])
def test_an_interrupted_run_goes_on_to_the_same_files_in_any_number_of_threads(
    drive, unbroken, tmp_path, frames
):
    for number, frame in enumerate(frames):
        with pytest.raises(KeyboardInterrupt, match="--resume"):
            _run(drive, tmp_path, Breaks(frame), resume=number > 0)
        assert [path.name for path in tmp_path.iterdir()] == [".partial"]
    run = _run(drive, tmp_path, resume=True, threads=2)
    assert content(tmp_path) == unbroken
    assert run.summary.to_json()["frames"] == FRAMES
    assert not (tmp_path / ".partial").exists()


def test_what_cannot_be_resumed_leaves_nothing(drive, tmp_path):
    with pytest.raises(FormatError):
        _run(drive, tmp_path / "run", Breaks(12, FormatError("image is truncated")))
    with pytest.raises(OutputError, match="no unfinished run"):
        _run(drive, tmp_path / "run", resume=True)
    assert list(tmp_path.iterdir()) == []


def test_other_settings_sources_and_poses_are_refused(drive, tmp_path):
    begun = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        _run(drive, begun, Breaks(12))
    with pytest.raises(SettingsError, match=r"other settings.*fusion.voxel_m = 0.3, expected 0.2"):
        _run(drive, begun, None, "fusion.voxel_m=0.3", resume=True)
    other = shutil.copytree(drive, tmp_path / "other")
    (other / "image_0" / "000007.png").write_bytes((drive / "image_0" / "000008.png").read_bytes())
    with pytest.raises(SettingsError, match="another source"):
        _run(other, begun, resume=True)
    truth = open_source(drive).truth
    with pytest.raises(SettingsError, match="other poses"):
        _run(drive, begun, resume=True, known_poses=truth.trajectory)
    assert (begun / STATE).is_file()


def test_a_second_run_is_refused(drive, unbroken, tmp_path):
    refused = []

    class Meddles(Breaks):
        def on_step(self, result: FrameResult) -> None:
            if getattr(result, "index", None) == 9:
                for resume in (False, True):
                    with pytest.raises(OutputError, match="another run") as told:
                        _run(drive, tmp_path, resume=resume)
                    refused.append(told.value)

    _run(drive, tmp_path, Meddles())
    assert len(refused) == 2
    assert content(tmp_path) == unbroken
