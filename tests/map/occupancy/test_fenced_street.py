"""A street of fences, railings, hedges, wires and shop windows, in which nothing moves."""

from __future__ import annotations

import pytest

from recon.commands.config import load_config
from recon.core.values import join_clouds
from recon.export.cloud import export_cloud
from recon.map.drive.sequence import map_sequence
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene


@pytest.mark.slow
def test_nothing_is_taken_for_moved_in_a_street_of_fences() -> None:
    scene = StreetScene(
        seed=4, frames=24, path="straight", fences=True, width_px=480, height_px=180, focal_px=270.0
    )
    source = SyntheticSource(scene)
    mapped = map_sequence(source, load_config(), known_poses=source.trajectory)
    removed = join_clouds(tile.removed for tile in mapped.tiles)
    cloud = join_clouds(tile.cloud for tile in mapped.tiles)
    assert len(cloud) > 20_000
    assert len(removed) <= 0.003 * len(cloud)


def test_without_rays_nothing_is_left_out_and_it_is_said(tmp_path) -> None:
    config = load_config(overrides=["occupancy.keep_rays=false"])
    source = SyntheticSource(StreetScene(frames=3, path="straight", width_px=160, height_px=64))
    mapped = map_sequence(source, config, known_poses=source.trajectory)
    written = export_cloud(mapped.tiles, tmp_path / "cloud.ply", tmp_path / "removed.ply")
    assert written.removed == 0
    assert any("keep_rays=true" in line for line in written.warnings)
