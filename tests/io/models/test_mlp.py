"""MeshLab projects open in MeshLab, wherever the folder is."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pymeshlab
import pytest

from recon.core.errors import OutputError
from recon.core.values import PointCloud, RectifiedCamera, TriangleMesh
from recon.core.values.cloud import Frame
from recon.io.images.image import write_image
from recon.io.models.mesh import write_mesh
from recon.io.models.mlp import Photo, write_mlp
from recon.io.models.ply import write_ply


def write_project(folder: Path) -> Path:
    xyz = np.eye(3, dtype=np.float32)
    write_ply(folder / "map" / "cloud & more.ply", PointCloud(np.tile(xyz, (4, 1))))
    write_mesh(folder / "mesh" / "mesh.ply", TriangleMesh(xyz, np.array([[0, 1, 2]], np.int32)))
    layers = {
        "cloud": folder / "map" / "cloud & more.ply",
        'the "mesh"': folder / "mesh" / "mesh.ply",
    }
    write_mlp(folder / "mesh" / "mesh.mlp", layers)
    return folder / "mesh" / "mesh.mlp"


def test_meshlab_opens_every_layer_after_the_folder_has_moved(tmp_path: Path) -> None:
    project = write_project(tmp_path / "here")
    shutil.move(tmp_path / "here", tmp_path / "there")
    meshes = pymeshlab.MeshSet()
    meshes.load_project(str(tmp_path / "there" / project.relative_to(tmp_path / "here")))
    sizes = [(mesh.vertex_number(), mesh.face_number()) for mesh in meshes]
    assert sizes == [(12, 0), (3, 1)]


def test_a_layer_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="does not exist"):
        write_mlp(tmp_path / "a.mlp", {"cloud": tmp_path / "none.ply"})
    assert list(tmp_path.iterdir()) == []


# x right, y up, z towards the viewer: what is ahead has a negative z.
RIGHT, UP, AHEAD = [1, 0, 0], [0, 1, 0], [0, 0, -1]


@pytest.mark.parametrize(
    ("frame", "axes"),
    [
        ("camera", {(1, 0, 0): RIGHT, (0, -1, 0): UP, (0, 0, 1): AHEAD}),
        ("map", {(0, -1, 0): RIGHT, (0, 0, 1): UP, (1, 0, 0): AHEAD}),
        (None, {(1, 0, 0): RIGHT, (0, 1, 0): UP, (0, 0, -1): AHEAD}),
    ],
)
def test_meshlab_shows_every_frame_upright_and_from_behind_the_camera(
    tmp_path: Path, frame: Frame | None, axes: dict[tuple[int, ...], list[int]]
) -> None:
    write_ply(tmp_path / "cloud.ply", PointCloud(np.array([*axes], dtype=np.float32)))
    write_mlp(tmp_path / "a.mlp", {"cloud": tmp_path / "cloud.ply"}, frame)
    meshes = pymeshlab.MeshSet()
    meshes.load_project(str(tmp_path / "a.mlp"))
    shown = meshes.current_mesh().transformed_vertex_matrix()
    np.testing.assert_array_equal(shown, [*axes.values()])
    np.testing.assert_array_equal(meshes.current_mesh().vertex_matrix(), [*axes])


def test_meshlab_reads_the_camera_of_a_photo(tmp_path: Path) -> None:
    camera = RectifiedCamera(120.0, 50.0, 20.0, 50.0, 0.1, 160, 120)
    write_image(tmp_path / "left.png", np.zeros((120, 160), np.uint8))
    write_ply(tmp_path / "cloud.ply", PointCloud(np.eye(3, dtype=np.float32)))
    layers = {"cloud": tmp_path / "cloud.ply"}
    write_mlp(tmp_path / "a.mlp", layers, "camera", Photo(tmp_path / "left.png", camera))
    meshes = pymeshlab.MeshSet()
    meshes.load_project(str(tmp_path / "a.mlp"))
    assert meshes.raster_number() == 1
    meshes.save_project(str(tmp_path / "b.mlp"))
    (camera_text,) = re.findall("<VCGCamera(.*?)/>", (tmp_path / "b.mlp").read_text())
    found = dict(re.findall(r'(\w+)="(.*?)"', camera_text))
    focal, pixel = float(found["FocalMm"]), float(found["PixelSizeMm"].split()[0])
    assert focal / pixel == pytest.approx(120)
    assert found["ViewportPx"] == "160 120"
    # From the lower left corner of the image; pixel centres are half a pixel from its borders.
    assert found["CenterPx"] == "50.5 99.5"
    assert found["TranslationVector"] == "0 0 0 1"
    turn = np.array(found["RotationMatrix"].split(), float).reshape(4, 4)
    np.testing.assert_array_equal(turn, np.eye(4))
