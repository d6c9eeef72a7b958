"""A small drive with ground truth, mapped once."""

from pathlib import Path

import pytest

from recon.commands.config import load_config
from recon.commands.demo import demo_source
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.street.settings import StreetScene
from tests.scenery.figures import leave_figures_blank
from tests.scenery.film import RIG, film
from tests.scenery.made_once import made_once

SMALL_STREET = {"frames": 12, "width_px": 256, "height_px": 96, "focal_px": 150.0}


@pytest.fixture(scope="module", autouse=True)
def no_figures(blank_figures):
    """Draw the figures of reports only where a command runs in a process of its own."""


@pytest.fixture(scope="session")
def street_film():
    """A drive whose places are recognised, rendered once."""
    return film(StreetScene(frames=12, seed=1, **RIG))


@pytest.fixture(scope="session")
def small_demo(tmp_path_factory):
    """The folder of a run; it must not be changed."""
    config = load_config(None, [f"street.{key}={value}" for key, value in SMALL_STREET.items()])

    def make(out: Path) -> None:
        options = MapOptions(audit=False, command="demo", out=out, mesh=False)
        with pytest.MonkeyPatch.context() as patch:
            leave_figures_blank(patch)
            run_map(demo_source(config), config, options)

    return made_once(tmp_path_factory, "demo", make)
