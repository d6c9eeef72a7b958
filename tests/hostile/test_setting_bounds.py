"""Every number of a drive's settings at both of its bounds: a map, or one clear line, soon."""

from __future__ import annotations

import resource
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from recon.commands.config import ReconConfig, load_config
from recon.core.errors import ReconError, SettingsError
from recon.export.make import make
from recon.export.product import Order
from recon.map.drive.sequence import map_sequence
from recon.map.settings import DriveSettings
from recon.run.run import Run
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.hostile.runs import DRIVE
from tests.scenery.bounds import Number, numbers_of

MATCHERS: Final = ("sad", "sgm", "opencv")
NUMBERS: Final = [one for one in numbers_of(DriveSettings) if "onnx" not in one.name]
MORE_BYTES: Final = 4_000_000_000
"""Of address space, for a drive of three small frames that takes a twentieth of it by default."""


@pytest.fixture(scope="module")
def street() -> SyntheticSource:
    return SyntheticSource(StreetScene(smooth_edges=False, **{**DRIVE, "frames": 3}))


@pytest.fixture
def little_memory() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MORE_BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def _map(source: SyntheticSource, overrides: list[str], out: Path) -> None:
    config = load_config(None, overrides)
    with Run("map", out, config) as run:
        mapped = map_sequence(source, config)
        make(Order(mapped.map, mapped.placed, run, config.mesh), ("cloud", "octomap", "grid"))


def _overrides(number: Number, value: float) -> list[str]:
    """Return the setting, with whatever makes it matter."""
    part = number.name.split(".")[1]
    text = int(value) if number.whole else value
    matcher = [f"matching.matcher={part}"] if part in MATCHERS else []
    return [f"{number.name}={text}", *matcher]


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("number", NUMBERS, ids=lambda number: number.name)
@pytest.mark.parametrize("end", ["low", "high"])
def test_a_setting_at_its_bound_gives_a_map_or_one_line(
    number: Number, end: str, street: SyntheticSource, tmp_path: Path
) -> None:
    overrides, line = _overrides(number, getattr(number, end)), ""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # of numpy: of what overflows, or is NaN
        try:
            _map(street, overrides, tmp_path / "out")
        except ReconError as error:
            line = str(error)
    assert "\n" not in line


@pytest.mark.parametrize(
    "setting", ["map_filters.voxel_m=26", "map_filters.radius_m=51", "grid.min_blob_cells=251"]
)
def test_margins_beyond_a_tile_are_refused(setting: str) -> None:
    name = setting.partition("=")[0]
    with pytest.raises(SettingsError, match=f"{name} reaches 5.* m, beyond a tile of 50 m"):
        load_config(None, [setting])
    load_config(None, [setting, "submaps.tile_m=60"])


def test_a_tile_of_a_mesh_is_as_wide_as_its_margins() -> None:
    with pytest.raises(SettingsError, match=r"mesh\.tile_m.*greater than or equal to 6"):
        load_config(None, ["mesh.tile_m=5.9"])
    assert ReconConfig().mesh.tile_m > 6
