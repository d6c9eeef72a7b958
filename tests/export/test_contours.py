"""Contours lie where the ground has their heights, and only where points show it."""

from types import SimpleNamespace

import numpy as np
import pytest

from recon.core.errors import MappingError
from recon.export import contours as made
from recon.export.contours import contours_product
from recon.io.models.rasters import RasterPlace

PLACE = RasterPlace(1.0, 456_000, 5_433_060, 60, 60)
TOP = np.array([456_030.0, 5_433_030.0])
CONTEXT = SimpleNamespace(crs="EPSG:25832")


def drawn(monkeypatch, path, heights, shown=None):
    """What a GIS reads of the contours of a ground (60, 60), and their interval."""
    pyogrio = pytest.importorskip("pyogrio")
    block = np.stack([heights, np.ones((60, 60)) if shown is None else shown])
    monkeypatch.setattr(made, "place_of", lambda context, cell_m: PLACE)
    monkeypatch.setattr(made, "ground_blocks", lambda *how: iter([(0, 0, block)]))
    figures = contours_product(CONTEXT, path).figures
    info = pyogrio.read_info(path)
    assert info["driver"] == "GPKG"
    assert info["geometry_type"] == "LineString"
    assert "25832" in info["crs"]
    _, _, shapes, (height, index) = pyogrio.raw.read(path)
    lines = [np.frombuffer(shape[9:], "<f8").reshape(-1, 2) for shape in shapes]
    assert figures.lines == len(lines)
    return lines, height, index, figures.interval_m


def cone() -> np.ndarray:
    return 100.0 - 0.1 * np.linalg.norm(PLACE.centres(0, 0, (60, 60)) - TOP, axis=2)


def test_lines_of_a_cone_are_circles_at_its_heights(monkeypatch, tmp_path):
    lines, height, index, interval_m = drawn(monkeypatch, tmp_path / "lines.gpkg", cone())
    assert interval_m in {0.1, 0.2}  # of 4.2 m at most fifty
    for line, level in zip(lines, height, strict=True):
        radius = np.linalg.norm(line - TOP, axis=1)
        # Between cells a cone is curved: most of all at its top.
        np.testing.assert_allclose(100.0 - 0.1 * radius, level, atol=0.02)
    whole = np.rint(height / interval_m)
    np.testing.assert_allclose(height, whole * interval_m, atol=1e-9)
    np.testing.assert_array_equal(index, whole % 5 == 0)
    assert 0 < index.sum() < len(index) / 3


def test_noise_widens_the_interval_and_what_no_point_shows_has_no_lines(monkeypatch, tmp_path):
    noise = np.random.default_rng(3).normal(0, 0.3, (60, 60))
    shown = np.ones((60, 60))
    shown[:, 30:] = 0
    lines, _, _, interval_m = drawn(monkeypatch, tmp_path / "a.gpkg", cone() + noise, shown)
    assert interval_m == 1.0  # three times 0.3 m, rounded up
    assert max(line[:, 0].max() for line in lines) < 456_029.51
    with pytest.raises(MappingError, match="no ground"):
        drawn(monkeypatch, tmp_path / "b.gpkg", cone(), np.zeros((60, 60)))
    assert not (tmp_path / "b.gpkg").exists()
