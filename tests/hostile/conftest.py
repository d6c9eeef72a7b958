"""Valid files of every kind, small, from which hostile ones are made."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.demo import demo_source
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.io.images.image import write_image
from recon.map.drive.mapper import FrameResult
from recon.run.work import Silent
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.kitti import write_kitti

DRIVE = {"frames": 6, "width_px": 256, "height_px": 96, "focal_px": 150.0}
STATE = Path(".partial") / ".state"


class _Stops(Silent):
    """A progress that interrupts a run at its fourth frame."""

    def on_step(self, result: FrameResult) -> None:
        if result.index == 3:
            raise KeyboardInterrupt


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder; a refused command must leave it as it was."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def pair(here: Path) -> tuple[Path, Path]:
    """Two images of 48x32 pixels with texture."""
    noise = np.random.default_rng(5).integers(0, 255, (32, 64), np.uint8)
    write_image(here / "left.png", noise[:, :48])
    write_image(here / "right.png", noise[:, 4:52])
    return here / "left.png", here / "right.png"


@pytest.fixture(scope="session")
def good_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive of three frames in KITTI's layout."""
    folder = tmp_path_factory.mktemp("good") / "drive"
    size = {"width_px": 128, "height_px": 64, "focal_px": 72.0}
    write_kitti(SyntheticSource(StreetScene(frames=3, smooth_edges=False, **size)), folder)
    return folder


@pytest.fixture
def drive(good_drive: Path, here: Path) -> Path:
    """A copy of the drive, to be spoiled."""
    return Path(shutil.copytree(good_drive, here / "drive"))


@pytest.fixture(scope="session")
def good_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with maps."""
    config = load_config(None, [f"street.{key}={value}" for key, value in DRIVE.items()])
    out = tmp_path_factory.mktemp("finished") / "run"
    run_map(
        demo_source(config), config, MapOptions(audit=False, command="demo", out=out, mesh=False)
    )
    return out


@pytest.fixture
def finished(good_run: Path, here: Path) -> Path:
    """A copy of the finished run, to be spoiled."""
    return Path(shutil.copytree(good_run, here / "run"))


@pytest.fixture(scope="session")
def good_state(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a drive (``drive``) and an interrupted run of it (``run``)."""
    folder = tmp_path_factory.mktemp("interrupted")
    write_kitti(SyntheticSource(StreetScene(smooth_edges=False, **DRIVE)), folder / "drive")
    config = load_config(None, ["checkpoints.every_frames=1", "submaps.length_m=1"])
    source, options = MapOptions(source=folder / "drive", mesh=False).open(config)
    options = replace(options, audit=False, out=folder / "run", progress=_Stops())
    with pytest.raises(KeyboardInterrupt):
        run_map(source, config, options)
    return folder


@pytest.fixture
def interrupted(good_state: Path, here: Path) -> Path:
    """A copy of the interrupted run, to be spoiled; its drive is that of the original."""
    return Path(shutil.copytree(good_state / "run", here / "run"))
