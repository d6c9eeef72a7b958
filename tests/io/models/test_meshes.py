"""Mesh files and MeshLab projects: each keeps what was written, and other programs read it."""

import json
import re
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pymeshlab
import pytest

from recon.core.errors import FormatError, OutputError
from recon.core.values import PointCloud, RectifiedCamera, Texture, TriangleMesh
from recon.io.images.image import write_image
from recon.io.models.mesh import MESH_SUFFIXES, Photo, read_mesh, write_glb, write_mesh, write_mlp
from recon.io.models.ply import write_ply

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], dtype=np.float32)
OUTWARDS = VERTICES - VERTICES.mean(axis=0)
MESH = TriangleMesh(
    vertices=VERTICES,
    faces=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32),
    normals=OUTWARDS / np.linalg.norm(OUTWARDS, axis=1, keepdims=True),
    rgb=np.array([[255, 0, 0], [0, 255, 0], [0, 127, 255], [10, 20, 30]], dtype=np.uint8),
)


def triangles(vertices: np.ndarray, faces: np.ndarray) -> set[tuple[tuple[float, ...], ...]]:
    """Corner positions of each face, from its smallest corner on: the order of files varies."""
    corners = [[tuple(np.round(vertices[i], 5).tolist()) for i in face] for face in faces]
    turned = [face[face.index(min(face)) :] + face[: face.index(min(face))] for face in corners]
    return {tuple(face) for face in turned}


# Text rounds; Open3D keeps a GLB's linear colours in bytes, which are coarse in the dark.
@pytest.mark.parametrize(("suffix", "off"), [*zip(MESH_SUFFIXES, (0, 1, None, 4), strict=True)])
def test_every_format_gives_triangles_and_colours_back(tmp_path, suffix, off):
    write_mesh(tmp_path / f"mesh{suffix}", MESH)
    again = read_mesh(tmp_path / f"mesh{suffix}")
    assert triangles(again.vertices, again.faces) == triangles(MESH.vertices, MESH.faces)
    if off is None:
        assert again.rgb is None
        return
    order = [int(np.argmin(np.abs(again.vertices - v).sum(axis=1))) for v in MESH.vertices]
    assert np.abs(again.rgb[order].astype(int) - MESH.rgb).max() <= off


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_a_texture_is_read_by_meshlab_where_it_was_written(tmp_path, suffix):
    image = np.zeros((4, 8, 3), np.uint8)
    image[:2, :, 0], image[:, 4:, 2] = 250, 90
    uv = np.array([[0.1, 0.2], [0.9, 0.2], [0.1, 0.7], [0.9, 0.7]], np.float32)
    path = tmp_path / f"mesh{suffix}"
    write_mesh(path, replace(MESH, texture=Texture(image, uv, "photo.png")))
    written = {".ply": ["photo.png"], ".obj": ["mesh.mtl", "photo.png"], ".glb": []}[suffix]
    assert sorted(file.name for file in tmp_path.iterdir() if file != path) == written
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(path))
    mesh = meshes.current_mesh()
    assert mesh.texture_number() == 1
    if mesh.has_wedge_tex_coord():
        meshes.compute_texcoord_transfer_wedge_to_vertex()
        mesh = meshes.current_mesh()
    # Counted from the lower left corner of the image.
    read = {
        tuple(np.round(vertex, 4)): place
        for vertex, place in zip(mesh.vertex_matrix(), mesh.vertex_tex_coord_matrix(), strict=True)
    }
    for vertex, (u, v) in zip(VERTICES, uv, strict=True):
        np.testing.assert_allclose(read[tuple(vertex)], (u, 1 - v), atol=1e-5)
    assert triangles(read_mesh(path).vertices, read_mesh(path).faces) == triangles(
        VERTICES, MESH.faces
    )


def test_ply_keeps_all_bit_by_bit_and_that_of_others_is_read(tmp_path):
    write_mesh(tmp_path / "mesh.ply", MESH)
    again = read_mesh(tmp_path / "mesh.ply")
    for name in ("vertices", "faces", "normals", "rgb"):
        np.testing.assert_array_equal(getattr(again, name), getattr(MESH, name))
    assert b"property float x" in (tmp_path / "mesh.ply").read_bytes()
    write_mesh(tmp_path / "mesh.ply", TriangleMesh(MESH.vertices, MESH.faces))
    assert read_mesh(tmp_path / "mesh.ply").rgb is None
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\ncomment by hand\nelement vertex 3\nproperty double x\n"
        "property double y\nproperty double z\nelement face 1\n"
        "property list uchar uint vertex_index\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.ply").faces, [[0, 1, 2]])


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".glb"])
def test_junk_and_missing_files_are_refused_quietly(tmp_path, suffix, capfd):
    with pytest.raises(FormatError, match="no such file"):
        read_mesh(tmp_path / f"none{suffix}")
    (tmp_path / f"junk{suffix}").write_bytes(b"junk")
    with pytest.raises(FormatError):
        read_mesh(tmp_path / f"junk{suffix}")
    with pytest.raises(OutputError):
        write_mesh(tmp_path / f"junk{suffix}" / "a.stl", MESH)
    assert capfd.readouterr().out == ""


def test_an_unknown_suffix_an_empty_mesh_and_a_missing_layer_are_not_written(tmp_path):
    with pytest.raises(OutputError, match=r"expected .ply .obj .stl .glb"):
        write_mesh(tmp_path / "mesh.xyz", MESH)
    empty = TriangleMesh(np.zeros((3, 3), np.float32), np.zeros((0, 3), np.int32))
    with pytest.raises(OutputError, match="no face"):
        write_mesh(tmp_path / "mesh.ply", empty)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OutputError, match="does not exist"):
        write_mlp(tmp_path / "a.mlp", {"cloud": tmp_path / "none.ply"})
    assert list(tmp_path.iterdir()) == []


def read_chunks(path: Path) -> tuple[dict, bytes]:
    data = path.read_bytes()
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert (kind, size % 4) == (b"JSON", 0)
    rest = 20 + size
    size, kind = struct.unpack_from("<I4s", data, rest)
    assert (kind, rest + 8 + size) == (b"BIN\0", len(data))
    return json.loads(data[20:rest]), data[rest + 8 :]


def test_the_arrays_of_a_glb_lie_where_the_accessors_say(tmp_path):
    write_glb(tmp_path / "mesh.glb", MESH)
    document, binary = read_chunks(tmp_path / "mesh.glb")
    primitive = document["meshes"][0]["primitives"][0]
    attributes = primitive["attributes"]

    def array(index: int, dtype: type, width: int) -> np.ndarray:
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        values = np.frombuffer(part, dtype).reshape(-1, width)
        assert len(values) == accessor["count"]
        return values

    np.testing.assert_array_equal(array(attributes["POSITION"], np.float32, 3), MESH.vertices)
    faces = array(primitive["indices"], np.uint32, 1).reshape(-1, 3)
    np.testing.assert_array_equal(faces, MESH.faces)
    colours = array(attributes["COLOR_0"], np.uint16, 4) / 65535
    # sRGB 127/255 is 0.2122 in linear light.
    np.testing.assert_allclose(colours[2], [0, 0.2122, 1, 1], atol=1e-4)
    box = document["accessors"][attributes["POSITION"]]
    assert (box["min"], box["max"]) == ([0, 0, 0], [1, 2, 3])


def test_only_colours_from_images_are_unlit_and_unknown_axes_are_not_turned(tmp_path):
    for name, rgb in (("grey", None), ("coloured", MESH.rgb), ("again", MESH.rgb)):
        write_glb(tmp_path / name, TriangleMesh(MESH.vertices, MESH.faces, rgb=rgb))
    documents = [read_chunks(tmp_path / name)[0] for name in ("grey", "coloured")]
    assert ["extensionsUsed" in document for document in documents] == [False, True]
    assert documents[0]["nodes"] == [{"mesh": 0}]
    assert (tmp_path / "coloured").read_bytes() == (tmp_path / "again").read_bytes()


@pytest.mark.parametrize(
    ("frame", "up", "ahead"), [("camera", [0, -1, 0], [0, 0, 1]), ("map", [0, 0, 1], [1, 0, 0])]
)
def test_the_node_turns_the_mesh_upright(tmp_path, frame, up, ahead):
    write_glb(tmp_path / "a.glb", MESH, frame)
    document, _ = read_chunks(tmp_path / "a.glb")
    turn = np.reshape(document["nodes"][0]["matrix"], (4, 4)).T
    # In glTF y is up, and a viewer looks along -z.
    np.testing.assert_array_equal(turn @ [*up, 1], [0, 1, 0, 1])
    np.testing.assert_array_equal(turn @ [*ahead, 1], [0, 0, -1, 1])
    assert np.linalg.det(turn) == pytest.approx(1)


def opened(project: Path) -> pymeshlab.MeshSet:
    meshes = pymeshlab.MeshSet()
    meshes.load_project(str(project))
    return meshes


def test_meshlab_opens_every_layer_after_the_folder_has_moved(tmp_path):
    cloud, mesh = tmp_path / "here/map/cloud & more.ply", tmp_path / "here/mesh/mesh.ply"
    write_ply(cloud, PointCloud(np.tile(MESH.vertices, (3, 1))))
    write_mesh(mesh, MESH)
    write_mlp(mesh.with_name("a.mlp"), {"cloud": cloud, 'the "mesh"': mesh})
    shutil.move(tmp_path / "here", tmp_path / "there")
    layers = opened(tmp_path / "there" / "mesh" / "a.mlp")
    assert [(one.vertex_number(), one.face_number()) for one in layers] == [(12, 0), (4, 4)]


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
def test_meshlab_shows_every_frame_upright_and_from_behind_the_camera(tmp_path, frame, axes):
    write_ply(tmp_path / "cloud.ply", PointCloud(np.array([*axes], dtype=np.float32)))
    write_mlp(tmp_path / "a.mlp", {"cloud": tmp_path / "cloud.ply"}, frame)
    meshes = opened(tmp_path / "a.mlp")  # which its meshes do not outlive
    shown = meshes.current_mesh()
    np.testing.assert_array_equal(shown.transformed_vertex_matrix(), [*axes.values()])
    np.testing.assert_array_equal(shown.vertex_matrix(), [*axes])


def test_meshlab_reads_the_camera_of_a_photo(tmp_path):
    camera = RectifiedCamera(120.0, 50.0, 20.0, 50.0, 0.1, 160, 120)
    write_image(tmp_path / "left.png", np.zeros((120, 160), np.uint8))
    write_ply(tmp_path / "cloud.ply", PointCloud(MESH.vertices))
    layers = {"cloud": tmp_path / "cloud.ply"}
    write_mlp(tmp_path / "a.mlp", layers, "camera", [Photo(tmp_path / "left.png", camera)])
    meshes = opened(tmp_path / "a.mlp")
    assert meshes.raster_number() == 1
    meshes.save_project(str(tmp_path / "b.mlp"))
    (camera_text,) = re.findall("<VCGCamera(.*?)/>", (tmp_path / "b.mlp").read_text())
    found = dict(re.findall(r'(\w+)="(.*?)"', camera_text))
    assert float(found["FocalMm"]) / float(found["PixelSizeMm"].split()[0]) == pytest.approx(120)
    # From the lower left corner of the image; pixel centres are half a pixel from its borders.
    assert (found["ViewportPx"], found["CenterPx"]) == ("160 120", "50.5 99.5")
    assert found["TranslationVector"] == "0 0 0 1"
    turn = np.array(found["RotationMatrix"].split(), float).reshape(4, 4)
    np.testing.assert_array_equal(turn, np.eye(4))
