"""Mesh files: each format keeps what was written, and other programs read it."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pymeshlab
import pytest

from recon.core.errors import FormatError, OutputError
from recon.core.values import TriangleMesh
from recon.core.values.cloud import Frame
from recon.io.models import open3d_meshes
from recon.io.models.mesh import MESH_SUFFIXES, read_mesh, srgb_from_linear, write_glb, write_mesh


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


MESH = TriangleMesh(
    vertices=np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], dtype=np.float32),
    faces=np.array([[0, 2, 1], [0, 1, 3]], dtype=np.int32),
    rgb=np.array([[0, 127, 255]] * 4, dtype=np.uint8),
)


def read_chunks(path: Path) -> tuple[dict, bytes]:
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    rest = 20 + size
    size, kind = struct.unpack_from("<I4s", data, rest)
    assert kind == b"BIN\0"
    assert rest + 8 + size == len(data)
    return json.loads(data[20:rest]), data[rest + 8 :]


def test_the_arrays_lie_where_the_accessors_say(tmp_path: Path) -> None:
    write_glb(tmp_path / "mesh.glb", MESH)
    document, binary = read_chunks(tmp_path / "mesh.glb")
    primitive = document["meshes"][0]["primitives"][0]

    def array(index: int, dtype: type, width: int) -> np.ndarray:
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        values = np.frombuffer(part, dtype).reshape(-1, width)
        assert len(values) == accessor["count"]
        return values

    np.testing.assert_array_equal(
        array(primitive["attributes"]["POSITION"], np.float32, 3), MESH.vertices
    )
    np.testing.assert_array_equal(
        array(primitive["indices"], np.uint32, 1).reshape(-1, 3), MESH.faces
    )
    colours = array(primitive["attributes"]["COLOR_0"], np.uint16, 4) / 65535
    # sRGB 127/255 is 0.2122 in linear light.
    np.testing.assert_allclose(colours, [[0, 0.2122, 1, 1]] * 4, atol=1e-4)
    box = document["accessors"][primitive["attributes"]["POSITION"]]
    assert (box["min"], box["max"]) == ([0, 0, 0], [1, 2, 3])


def test_srgb_from_linear_is_monotonic_and_keeps_the_ends() -> None:
    curve = srgb_from_linear(np.arange(256, dtype=np.uint8))
    assert (curve[0], curve[255]) == (0, 255)
    assert (np.diff(curve.astype(int)) >= 0).all()


def test_only_colours_from_images_are_unlit_and_unknown_axes_are_not_turned(tmp_path: Path) -> None:
    for name, rgb in (("grey", None), ("coloured", MESH.rgb), ("again", MESH.rgb)):
        write_glb(tmp_path / name, TriangleMesh(MESH.vertices, MESH.faces, rgb=rgb))
    documents = [read_chunks(tmp_path / name)[0] for name in ("grey", "coloured")]
    assert ["extensionsUsed" in document for document in documents] == [False, True]
    assert documents[0]["nodes"] == [{"mesh": 0}]
    assert (tmp_path / "coloured").read_bytes() == (tmp_path / "again").read_bytes()


@pytest.mark.parametrize(
    ("frame", "up", "ahead"), [("camera", [0, -1, 0], [0, 0, 1]), ("map", [0, 0, 1], [1, 0, 0])]
)
def test_the_node_turns_the_mesh_upright(
    tmp_path: Path, frame: Frame, up: list[int], ahead: list[int]
) -> None:
    write_glb(tmp_path / "a.glb", MESH, frame)
    document, _ = read_chunks(tmp_path / "a.glb")
    turn = np.reshape(document["nodes"][0]["matrix"], (4, 4)).T
    # In glTF y is up, and a viewer looks along -z.
    np.testing.assert_array_equal(turn @ [*up, 1], [0, 1, 0, 1])
    np.testing.assert_array_equal(turn @ [*ahead, 1], [0, 0, -1, 1])
    assert np.linalg.det(turn) == pytest.approx(1)


def sheet(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A flat sheet of 2·n² triangles."""
    y, x = np.mgrid[: n + 1, : n + 1]
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)
    at = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]).astype(np.int32)
    return vertices, faces


def test_components_are_counted_and_labelled() -> None:
    vertices, faces = sheet(3)
    two = np.concatenate([faces, faces[:4] + len(vertices)])
    labels, sizes = open3d_meshes.component_labels(np.concatenate([vertices, vertices + 99]), two)
    assert sizes[labels[0]] == 18
    assert labels[0] not in labels[18:]


def test_decimation_keeps_a_flat_sheet_flat_and_its_border() -> None:
    vertices, faces = open3d_meshes.decimate(*sheet(12), 40)
    assert len(faces) <= 40
    np.testing.assert_allclose(vertices[:, 2], 0, atol=1e-6)
    # Corners of a border may be cut a little where edges collapse.
    np.testing.assert_allclose(np.ptp(vertices[:, :2], axis=0), 12, atol=0.5)


def test_what_open3d_cannot_read_or_write_is_an_error_of_ours(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    vertices, faces = sheet(1)
    with pytest.raises(OutputError):
        open3d_meshes.write_mesh(tmp_path / "none" / "a.stl", TriangleMesh(vertices, faces))
    (tmp_path / "junk.obj").write_text("junk\n")
    with pytest.raises(FormatError):
        open3d_meshes.read_mesh(tmp_path / "junk.obj")
    assert capfd.readouterr().out == ""
