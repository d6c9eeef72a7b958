"""The occupancy of rendered drives against ground truth: several streets, one configuration."""

from __future__ import annotations

import pytest

from recon.commands.config import load_config
from recon.commands.demo import demo_source
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.values import OccupancyMetrics

STREETS = {
    "curve": ["street.seed=1"],
    "another": ["street.seed=3"],
    "straight, tilted camera": ["street.seed=5", "street.path=straight", "street.pitch_deg=4"],
}


def _map(overrides: list[str], out) -> OccupancyMetrics:
    config = load_config(None, ["street.frames=30", *overrides])
    run = run_map(demo_source(config), config, MapOptions(audit=False, out=out, mesh=False))
    assert run.errors.occupancy is not None
    assert run.summary["occupancy"]["voxels"]["recall"] == run.errors.occupancy.voxels.recall
    return run.errors.occupancy


@pytest.mark.slow
@pytest.mark.parametrize("street", STREETS)
def test_occupied_and_free_are_where_they_really_are(street, tmp_path) -> None:
    found = _map(STREETS[street], tmp_path / "run")
    # What is asked for, seen at least three times; measured 0.94 to 0.96, and 0.98.
    assert found.voxels.precision >= 0.9
    assert found.voxels.recall >= 0.9
    # Within one cell; the very cell gives 0.65 to 0.71.
    assert 0.8 <= found.grid.iou_occupied < 1
    # The very cell.
    assert 0.95 <= found.grid_exact.iou_free < 1
    assert found.grid.occupied_called_free < 0.05
