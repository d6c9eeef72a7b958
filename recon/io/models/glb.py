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

_FLOAT, _UINT, _USHORT = 5126, 5125, 5123
_VERTICES, _INDICES = 34962, 34963
_MATERIAL: Final = {
    "doubleSided": True,
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
}
#: Colours taken from images already include the lighting.
_UNLIT: Final = "KHR_materials_unlit"


def write_glb(path: StrPath, mesh: TriangleMesh, frame: Frame | None = None) -> None:
    """Write a mesh as GLB with float vertices, without changing its coordinates.

    The y axis of glTF is up, so the node of the mesh is rotated upright if the frame is known.

    Vertex colours of glTF are linear, so sRGB colours are converted, to 16 bits to keep dark tones
    distinct.

    Raises:
        OutputError: The file cannot be written.
    """
    attributes: dict[str, tuple[NDArray[Any], int]] = {"POSITION": (mesh.vertices, _FLOAT)}
    if mesh.normals is not None:
        attributes["NORMAL"] = (mesh.normals, _FLOAT)
    if mesh.rgb is not None:
        attributes["COLOR_0"] = (_linear(mesh.rgb), _USHORT)
    document, binary = _document(mesh, attributes)
    if frame is not None:
        # Column by column, in metres.
        document["nodes"][0]["matrix"] = T_YUP_FRAME[frame].T.ravel().tolist()
    head = _chunk(b"JSON", json.dumps(document).encode(), b" ")
    body = _chunk(b"BIN\0", binary, b"\0")
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
    opaque = np.ones((len(rgb), 1))
    whole = np.rint(np.concatenate([curve, opaque], axis=1) * 65535)
    return np.asarray(whole, dtype=np.uint16)


def _document(
    mesh: TriangleMesh, attributes: dict[str, tuple[NDArray[Any], int]]
) -> tuple[dict[str, Any], bytes]:
    """Return the JSON part, and the arrays it describes as one block of bytes."""
    arrays = [*attributes.values(), (mesh.faces.astype(np.uint32).reshape(-1, 1), _UINT)]
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for values, component in arrays:
        target = _INDICES if component == _UINT else _VERTICES
        views.append(
            {"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes, "target": target}
        )
        accessors.append(_accessor(values, component, len(accessors)))
        offset += values.nbytes
    # glTF requires the bounding box of the positions.
    accessors[0] |= {
        "min": mesh.vertices.min(axis=0).tolist(),
        "max": mesh.vertices.max(axis=0).tolist(),
    }
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "indices": len(attributes),
        "material": 0,
    }
    coloured = mesh.rgb is not None
    document = {
        "asset": {"version": "2.0", "generator": "recon"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [_MATERIAL | ({"extensions": {_UNLIT: {}}} if coloured else {})],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    } | ({"extensionsUsed": [_UNLIT]} if coloured else {})
    return document, b"".join(np.ascontiguousarray(values).tobytes() for values, _ in arrays)


def _accessor(values: NDArray[Any], component: int, view: int) -> dict[str, Any]:
    """Return the description of one array."""
    kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
    return {
        "bufferView": view,
        "componentType": component,
        "count": len(values),
        "type": kind,
        "normalized": component == _USHORT,
    }


def _chunk(kind: bytes, content: bytes, filler: bytes) -> bytes:
    """Return one chunk of the container, padded to a multiple of four bytes."""
    content += filler * (-len(content) % 4)
    return struct.pack("<I4s", len(content), kind) + content
