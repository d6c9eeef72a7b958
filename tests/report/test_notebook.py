"""Values show themselves, and import what draws only when they are asked."""

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import recon
from recon.core.values import FREE, OCCUPIED, UNKNOWN

XYZ = np.random.default_rng(0).uniform(-2, 2, (30, 3)).astype(np.float32)
RGB = np.full((30, 3), 51, np.uint8)
FACES = np.arange(30, dtype=np.int32).reshape(10, 3)
T = np.tile(np.eye(4), (3, 1, 1))
VALUES = (
    recon.Disparity.from_values(np.linspace(0.0, 9.0, 60).reshape(6, 10)),
    recon.Disparity.from_values(np.full((3, 4), np.nan)),
    recon.PointCloud(XYZ, RGB, frame="map"),
    recon.PointCloud(XYZ),
    recon.PointCloud(np.zeros((0, 3), np.float32)),
    recon.PointCloud(np.ones((1, 3), np.float32), frame="world"),
    recon.OccupancyGrid(np.array([[FREE, OCCUPIED, UNKNOWN]], np.int8), 0.5, (-1.0, 2.0)),
    recon.Trajectory(T, np.arange(3.0)),
    recon.Trajectory(T[:0], np.zeros(0)),
    recon.TriangleMesh(XYZ, FACES, rgb=RGB),
    recon.TriangleMesh(XYZ, FACES),
    recon.TriangleMesh(XYZ[:0], FACES[:0]),
)


@pytest.mark.parametrize("value", VALUES, ids=repr)
@pytest.mark.filterwarnings("error")
def test_a_value_is_shown_as_a_picture_with_its_text(value):
    html = value._repr_html_()
    assert re.fullmatch(r'<img src="data:image/png;base64,[\w+/=]+" alt="[^"<>]+">', html)
    assert type(value).__name__ in html
    assert value.plot()._repr_png_().startswith(b"\x89PNG")


def test_a_picture_has_the_places_and_colours_of_the_value():
    grid = VALUES[6].plot().axes[0]
    assert list(grid.images[0].get_extent()) == [-1.0, 0.5, 2.0, 2.5]
    assert grid.images[0].get_array()[0, 1].tolist() == [24, 28, 34]
    (image,) = VALUES[2].plot().axes[0].images
    pixels = np.asarray(image.get_array())
    assert (pixels[pixels[..., 3] == 255] == (51, 51, 51, 255)).all()
    assert 0 < (pixels[..., 3] == 255).mean() < 0.5


def test_what_was_inferred_is_hatched():
    whole = VALUES[0]
    reason = np.where(np.arange(10) < 5, whole.reason, np.uint8(recon.Reason.FILLED))
    both = replace(whole.reject(~whole.valid | (np.arange(10) == 0), recon.Reason.EDGE))
    reason = np.where(both.valid, reason, both.reason)
    axes = replace(both, reason=reason).plot().axes[0]
    assert len(axes.images) == 2
    assert axes.get_legend().get_texts()[0].get_text() == "inferred from planes around"
    assert len(whole.plot().axes[0].images) == 1


def test_open3d_gets_copies_with_colours_and_normals():
    up = np.tile(np.float32([0, 0, 1]), (30, 1))
    cloud = recon.PointCloud(XYZ, RGB, up).to_open3d()
    np.testing.assert_array_equal(np.asarray(cloud.points, np.float32), XYZ)
    np.testing.assert_allclose(np.asarray(cloud.colors), 0.2)
    np.testing.assert_array_equal(np.asarray(cloud.normals), up)
    mesh = recon.TriangleMesh(XYZ, FACES, up, RGB).to_open3d()
    np.testing.assert_array_equal(np.asarray(mesh.triangles), FACES)
    np.testing.assert_allclose(np.asarray(mesh.vertex_colors), 0.2)
    assert mesh.has_vertex_normals()
    assert not recon.PointCloud(XYZ).to_open3d().has_colors()


def test_values_alone_load_nothing_that_draws():
    code = "import sys, recon.core.values; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"matplotlib", "open3d", "plotly", "recon.report"} & {*done.stdout.split()}
