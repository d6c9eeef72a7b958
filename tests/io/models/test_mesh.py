"""Mesh files: each format keeps what was written, and other programs read it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pymeshlab
import pytest

from recon.core.errors import FormatError, OutputError
from recon.core.values import TriangleMesh
from recon.io.models.mesh import MESH_SUFFIXES, read_mesh, write_mesh


def tetrahedron(*, coloured: bool = True) -> TriangleMesh:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)
    outwards = vertices - vertices.mean(axis=0)
    return TriangleMesh(
        vertices=vertices,
        faces=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32),
        normals=outwards / np.linalg.norm(outwards, axis=1, keepdims=True),
        rgb=np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [10, 20, 30]], dtype=np.uint8)
        if coloured
        else None,
    )


def triangles(vertices: np.ndarray, faces: np.ndarray) -> set[tuple[tuple[float, ...], ...]]:
    """Corner positions of each face, from its smallest corner on: the order of files varies."""
    corners = [[tuple(np.round(vertices[i], 5).tolist()) for i in face] for face in faces]
    turned = [face[face.index(min(face)) :] + face[: face.index(min(face))] for face in corners]
    return {tuple(face) for face in turned}


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
def test_every_format_gives_the_triangles_back(tmp_path: Path, suffix: str) -> None:
    mesh = tetrahedron()
    write_mesh(tmp_path / f"mesh{suffix}", mesh)
    again = read_mesh(tmp_path / f"mesh{suffix}")
    assert triangles(again.vertices, again.faces) == triangles(mesh.vertices, mesh.faces)


# Text rounds; Open3D keeps a GLB's linear colours in bytes, which are coarse in the dark.
@pytest.mark.parametrize(("suffix", "off"), [(".ply", 0), (".obj", 1), (".glb", 4)])
def test_colours_survive(tmp_path: Path, suffix: str, off: int) -> None:
    mesh = tetrahedron()
    write_mesh(tmp_path / f"mesh{suffix}", mesh)
    again = read_mesh(tmp_path / f"mesh{suffix}")
    assert again.rgb is not None
    order = [int(np.argmin(np.abs(again.vertices - v).sum(axis=1))) for v in mesh.vertices]
    assert np.abs(again.rgb[order].astype(int) - mesh.rgb).max() <= off


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl"])
def test_meshlab_opens_it(tmp_path: Path, suffix: str) -> None:
    mesh = tetrahedron()
    write_mesh(tmp_path / f"mesh{suffix}", mesh)
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(tmp_path / f"mesh{suffix}"))
    seen = meshes.current_mesh()
    assert triangles(seen.vertex_matrix(), seen.face_matrix()) == triangles(
        mesh.vertices, mesh.faces
    )


def test_ply_keeps_floats_normals_and_colours_bit_by_bit(tmp_path: Path) -> None:
    mesh = tetrahedron()
    write_mesh(tmp_path / "mesh.ply", mesh)
    again = read_mesh(tmp_path / "mesh.ply")
    for name in ("vertices", "faces", "normals", "rgb"):
        np.testing.assert_array_equal(getattr(again, name), getattr(mesh, name))
    assert b"property float x" in (tmp_path / "mesh.ply").read_bytes()


def test_a_mesh_without_colours_has_none_when_read(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh.ply", tetrahedron(coloured=False))
    assert read_mesh(tmp_path / "mesh.ply").rgb is None


def test_an_ascii_mesh_of_others_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 3\nproperty double x\n"
        "property double y\nproperty double z\nelement face 1\n"
        "property list uchar uint vertex_index\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.ply").faces, [[0, 1, 2]])


@pytest.mark.parametrize(
    ("faces", "complaint"),
    [("4 0 1 2 0", "truncated|triangle"), ("3 0 1 7", "does not exist"), ("3 0 1", "truncated")],
)
def test_broken_faces_are_refused(tmp_path: Path, faces: str, complaint: str) -> None:
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        f"0 0 0\n1 0 0\n0 1 0\n{faces}\n"
    )
    with pytest.raises(FormatError, match=complaint):
        read_mesh(tmp_path / "a.ply")


def test_a_truncated_mesh_is_refused(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh.ply", tetrahedron())
    (tmp_path / "mesh.ply").write_bytes((tmp_path / "mesh.ply").read_bytes()[:-5])
    with pytest.raises(FormatError, match="truncated in its element 'face'"):
        read_mesh(tmp_path / "mesh.ply")


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".glb"])
def test_junk_and_missing_files_are_refused_quietly(
    tmp_path: Path, suffix: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(FormatError, match="no such file"):
        read_mesh(tmp_path / f"none{suffix}")
    (tmp_path / f"junk{suffix}").write_bytes(b"junk")
    with pytest.raises(FormatError):
        read_mesh(tmp_path / f"junk{suffix}")
    assert capfd.readouterr().out == ""


def test_an_unknown_suffix_and_an_empty_mesh_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"expected .ply .obj .stl .glb"):
        write_mesh(tmp_path / "mesh.xyz", tetrahedron())
    with pytest.raises(FormatError, match="unknown kind"):
        read_mesh(tmp_path / "mesh.xyz")
    empty = TriangleMesh(np.zeros((3, 3), np.float32), np.zeros((0, 3), np.int32))
    with pytest.raises(OutputError, match="no face"):
        write_mesh(tmp_path / "mesh.ply", empty)
    assert list(tmp_path.iterdir()) == []


def test_a_cloud_is_no_mesh(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n0 0 0\n"
    )
    with pytest.raises(FormatError, match="it is a point cloud"):
        read_mesh(tmp_path / "a.ply")
