"""LAS and LAZ files hold the points in the coordinates of a survey, to the millimetre."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import EvaluationError, MissingDependencyError, SettingsError
from recon.core.geometry.se3 import make_transform
from recon.core.values import PointCloud
from recon.io.models.las import check_crs, check_inside, write_las

laspy = pytest.importorskip("laspy")

T_SURVEY_MAP = make_transform(
    np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([456789.25, 5433210.5, 118.75]),
)


def some_cloud(seed: int, points: int = 1000) -> PointCloud:
    random = np.random.default_rng(seed)
    return PointCloud(
        random.uniform(-200, 200, (points, 3)).astype(np.float32),
        rgb=random.integers(0, 256, (points, 3)).astype(np.uint8),
        sigma_m=random.uniform(0, 2, points).astype(np.float32),
        frame="map",
    )


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_points_come_back_turned_and_moved(tmp_path: Path, suffix: str) -> None:
    clouds = [some_cloud(1), some_cloud(2, 10)]
    path = tmp_path / f"cloud.{suffix}"
    assert write_las(path, clouds, T_SURVEY_MAP, "EPSG:25832") == 1010
    found = laspy.read(path)
    x, y, z = np.concatenate([cloud.xyz for cloud in clouds]).astype(np.float64).T
    expected = np.stack([456789.25 - y, 5433210.5 + x, 118.75 + z], axis=1)
    assert np.abs(found.xyz - expected).max() <= 0.00051
    for n, name in enumerate(("red", "green", "blue")):
        rgb = np.concatenate([cloud.rgb for cloud in clouds if cloud.rgb is not None])
        np.testing.assert_array_equal(found[name], rgb[:, n].astype(np.uint16) * 257)
    sigma = [cloud.sigma_m for cloud in clouds if cloud.sigma_m is not None]
    np.testing.assert_array_equal(found["sigma"], np.concatenate(sigma))
    assert found.header.parse_crs().to_epsg() == 25832
    np.testing.assert_allclose(found.header.maxs, expected.max(axis=0), atol=0.001)


def test_positions_alone_are_enough(tmp_path: Path) -> None:
    path = tmp_path / "cloud.laz"
    write_las(path, [PointCloud(np.ones((1, 3), np.float32))], np.eye(4))
    found = laspy.read(path)
    np.testing.assert_allclose(found.xyz, 1.0)
    assert found.header.parse_crs() is None


def test_each_point_is_the_only_return_of_its_ray(tmp_path: Path) -> None:
    write_las(tmp_path / "cloud.las", [some_cloud(1)], np.eye(4))
    found = laspy.read(tmp_path / "cloud.las")
    assert set(found.return_number) == {1}  # the specification permits no 0
    assert set(found.number_of_returns) == {1}
    assert found.header.number_of_points_by_return[0] == 1000


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("EPSG:99", "unknown coordinate system"),
        ("Gauss", "unknown coordinate system"),
        ("EPSG:4326", "not metres"),  # degrees
        ("EPSG:4978", "not metres"),  # metres, but from the centre of the earth
        ("EPSG:2263", "not metres"),  # feet
    ],
)
def test_other_coordinates_are_refused(tmp_path: Path, name: str, why: str) -> None:
    with pytest.raises(SettingsError, match=why):
        write_las(tmp_path / "cloud.laz", [], np.eye(4), name)
    assert not list(tmp_path.iterdir())


def test_a_system_with_heights_is_taken() -> None:
    assert check_crs("EPSG:25832+7837").to_epsg(min_confidence=0) is None


@pytest.mark.parametrize(
    ("name", "east", "north", "inside"),
    [
        ("EPSG:25832", 456789.0, 5433210.0, True),
        ("EPSG:25832", 5433210.0, 456789.0, False),  # swapped
        ("EPSG:25832", 8.4, 49.0, False),  # degrees
        ("EPSG:3857", -1.9e7, -1.0e6, True),  # the whole world
        ("EPSG:32760", 1.0e5, 8.0e6, True),  # beside the line where dates change
        ("EPSG:3832", 3.0e6, 1.0e6, True),  # an area across that line
        ("EPSG:3832", -1.6e7, 1.0e6, False),  # Greenwich
        ("+proj=utm +zone=32 +ellps=GRS80 +units=m", 0.0, 0.0, True),  # no area is stated
    ],
)
def test_positions_lie_in_the_area_of_their_system(
    name: str, east: float, north: float, inside: bool
) -> None:
    if inside:
        check_inside(name, np.array([east, north, 100.0]), "gnss.txt")
        return
    with pytest.raises(EvaluationError, match=r"gnss\.txt: the positions lie outside the area"):
        check_inside(name, np.array([east, north, 100.0]), "gnss.txt")


def test_without_laspy_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(MissingDependencyError, match=r"recon\[survey\]"):
        write_las(tmp_path / "cloud.laz", [], np.eye(4))
