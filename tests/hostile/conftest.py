"""Valid files of every kind, small, from which hostile ones are made."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.demo import demo_source
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.progress import showing
from recon.io.images.image import write_image
from tests.flow.runs import Breaks
from tests.scenery.figures import leave_figures_blank
from tests.scenery.kitti import street_drive
from tests.scenery.made_once import made_once

DRIVE = {"frames": 6, "width_px": 256, "height_px": 96, "focal_px": 150.0}
STATE = Path(".partial") / ".state"


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty working folder; a refused command must leave it as it was."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def pair(here):
    """Two images of 48x32 pixels with texture."""
    noise = np.random.default_rng(5).integers(0, 255, (32, 64), np.uint8)
    write_image(here / "left.png", noise[:, :48])
    write_image(here / "right.png", noise[:, 4:52])
    return here / "left.png", here / "right.png"


@pytest.fixture(scope="session")
def good_drive(tmp_path_factory):
    return street_drive(tmp_path_factory.mktemp("good") / "drive", 3, 128, height_px=64)


@pytest.fixture
def drive(good_drive, here):
    return Path(shutil.copytree(good_drive, here / "drive"))


@pytest.fixture(scope="session")
def good_run(tmp_path_factory):
    config = load_config(None, [f"street.{key}={value}" for key, value in DRIVE.items()])

    def make(out: Path) -> None:
        options = MapOptions(audit=False, command="demo", out=out, mesh=False)
        with pytest.MonkeyPatch.context() as patch:
            leave_figures_blank(patch)
            run_map(demo_source(config), config, options)

    return made_once(tmp_path_factory, "finished", make)


@pytest.fixture
def finished(good_run, here):
    return Path(shutil.copytree(good_run, here / "run"))


@pytest.fixture(scope="session")
def good_state(tmp_path_factory):
    """A folder with a drive (``drive``) and an interrupted run of it (``run``)."""
    folder = tmp_path_factory.mktemp("interrupted")
    street_drive(folder / "drive", **DRIVE)
    config = load_config(None, ["checkpoints.every_frames=1", "submaps.length_m=1"])
    source, options = MapOptions(source=folder / "drive", mesh=False).open(config)
    options = replace(options, audit=False, out=folder / "run")
    with pytest.raises(KeyboardInterrupt), showing(Breaks(3)):
        run_map(source, config, options)
    return folder


@pytest.fixture
def interrupted(good_state, here):
    """A copy of the interrupted run, to be spoiled; its drive is that of the original."""
    return Path(shutil.copytree(good_state / "run", here / "run"))
