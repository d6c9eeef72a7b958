"""MeshLab projects open in MeshLab, wherever the folder is."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pymeshlab
import pytest

from recon.errors import OutputError
from recon.formats.mesh import write_mesh
from recon.formats.mlp import write_mlp
from recon.formats.ply import write_ply
from recon.structures import PointCloud, TriangleMesh


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


def test_names_are_relative_to_the_project(tmp_path: Path) -> None:
    text = write_project(tmp_path).read_text()
    assert 'filename="../map/cloud &amp; more.ply"' in text
    assert 'filename="mesh.ply"' in text
    assert str(tmp_path) not in text


def test_a_layer_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="does not exist"):
        write_mlp(tmp_path / "a.mlp", {"cloud": tmp_path / "none.ply"})
    assert list(tmp_path.iterdir()) == []
