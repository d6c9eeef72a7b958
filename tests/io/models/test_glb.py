"""GLB: container and JSON follow the specification."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from recon.core.values import TriangleMesh
from recon.core.values.cloud import Frame
from recon.io.models.mesh import srgb_from_linear, write_glb

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
    ("frame", "up", "ahead"),
    [("camera", [0, -1, 0], [0, 0, 1]), ("map", [0, 0, 1], [1, 0, 0])],
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
