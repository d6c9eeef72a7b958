"""Meshes as binary glTF 2.0 (.glb), for browsers, Blender and phones.

Ref: Khronos Group, "glTF 2.0 specification", sections 3.6 (buffers), 3.7 (meshes), 4.4 (GLB).
"""

from __future__ import annotations

import json
import struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.axes import T_YUP_FRAME
from recon.core.values import TriangleMesh
from recon.core.values.arrays import UInt8
from recon.core.values.cloud import Frame
from recon.io.atomic import write_bytes
from recon.io.files import StrPath

_COMPONENTS: Final = {"float32": 5126, "uint32": 5125, "uint16": 5123}
_KINDS: Final = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_VERTICES, _INDICES = 34962, 34963
_MATTE: Final = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
#: Colours taken from images already include the lighting.
_UNLIT: Final = "KHR_materials_unlit"


def write_glb(path: StrPath, mesh: TriangleMesh, frame: Frame | None = None) -> None:
    """Write a mesh as GLB with float vertices, without changing its coordinates.

    The y axis of glTF is up, so the node of the mesh is rotated upright if the frame is known.

    Vertex colours of glTF are linear, so sRGB colours are converted, to 16 bits to keep dark tones
    distinct.
    """
    vertices: dict[str, NDArray[Any]] = {"POSITION": mesh.vertices}
    if mesh.normals is not None:
        vertices["NORMAL"] = mesh.normals
    if mesh.rgb is not None:
        vertices["COLOR_0"] = _linear(mesh.rgb)
    arrays = [*vertices.values(), mesh.faces.astype(np.uint32).reshape(-1, 1)]
    views, accessors = _described(arrays)
    # glTF requires the bounding box of the positions.
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    accessors[0] |= {"min": low.tolist(), "max": high.tolist()}
    attributes = {name: number for number, name in enumerate(vertices)}
    primitive = {"attributes": attributes, "indices": len(vertices), "material": 0}
    unlit: dict[str, Any] = {"extensions": {_UNLIT: {}}} if mesh.rgb is not None else {}
    # Column by column, in metres.
    turn = {} if frame is None else {"matrix": T_YUP_FRAME[frame].T.ravel().tolist()}
    document = {
        "asset": {"version": "2.0", "generator": "recon"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0} | turn],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": _MATTE} | unlit],
        "buffers": [{"byteLength": sum(values.nbytes for values in arrays)}],
        "bufferViews": views,
        "accessors": accessors,
    } | ({"extensionsUsed": [_UNLIT]} if unlit else {})
    head = _chunk(b"JSON", json.dumps(document).encode(), b" ")
    body = _chunk(b"BIN\0", b"".join(values.tobytes() for values in arrays), b"\0")
    length = 12 + len(head) + len(body)
    write_bytes(path, struct.pack("<4sII", b"glTF", 2, length) + head + body)


def srgb_from_linear(rgb: UInt8) -> UInt8:
    """Convert linear colours back to sRGB, for readers that ignore the colour space."""
    share = rgb / 255
    curve = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(curve * 255), dtype=np.uint8)


def _linear(rgb: UInt8) -> NDArray[np.uint16]:
    """Return uint16 (V, 4): linear red, green, blue and full opacity (IEC 61966-2-1)."""
    share = rgb / 255
    curve = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.rint(np.insert(curve, 3, 1.0, axis=1) * 65535), dtype=np.uint16)


def _described(arrays: list[NDArray[Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return views and accessors: where each array lies in the block of bytes, and its form."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for view, values in enumerate(arrays):
        size, kind = values.nbytes, values.dtype.name
        target = _INDICES if kind == "uint32" else _VERTICES
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": size, "target": target})
        shape = {"bufferView": view, "componentType": _COMPONENTS[kind], "count": len(values)}
        form = {"type": _KINDS[values.shape[1]], "normalized": kind == "uint16"}
        accessors.append(shape | form)
        offset += size
    return views, accessors


def _chunk(kind: bytes, content: bytes, filler: bytes) -> bytes:
    """Return one chunk of the container, padded to a multiple of four bytes."""
    content += filler * (-len(content) % 4)
    return struct.pack("<I4s", len(content), kind) + content
