"""Meshes as PLY, OBJ, STL and GLB files, and MeshLab projects (.mlp) of several layers."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError, MeshingError, OutputError, SettingsError
from recon.core.geometry.se3 import T_YUP_FRAME, make_transform
from recon.core.lazy import Lazy, quiet_open3d
from recon.core.text import counted
from recon.core.values import RectifiedCamera, Texture, TriangleMesh
from recon.core.values.arrays import Float32, Float64, Int32, UInt8
from recon.core.values.cloud import Frame
from recon.io.atomic import atomic_path, write_bytes, write_text
from recon.io.files import StrPath, reader, resolved
from recon.io.images.image import encode_image, write_image
from recon.io.models.columns import Table, attributes_in, columns_of, positions_in, table_of
from recon.io.models.ply import LIST_LENGTH, read_tables, write_table_parts, write_tables

MESH_SUFFIXES: Final = (".ply", ".obj", ".stl", ".glb")
_INDICES: Final = ("vertex_indices", "vertex_index")  # both names are in use
_COMPONENTS: Final = {"float32": 5126, "uint32": 5125, "uint16": 5123}
_KINDS: Final = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_VERTEX_BUFFER, _INDEX_BUFFER = 34962, 34963
_MATTE: Final[dict[str, Any]] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
_TEXTURE: Final = "TextureFile "  # the comment of a PLY that names an image, as MeshLab has it
_UNLIT: Final = "KHR_materials_unlit"  # colours of images already include the lighting


def write_mesh(path: StrPath, mesh: TriangleMesh, frame: Frame | None = None) -> None:
    """Write a mesh atomically, as .ply, .obj, .stl or .glb by the suffix of the file.

    PLY (binary, float), OBJ and GLB keep normals, colours and texture. The image of a texture is
    written beside a PLY or OBJ, with a material beside OBJ; GLB has it inside, and is shown upright
    if the ``frame`` of the axes is known.

    Raises:
        OutputError: The suffix is unknown, the mesh has no face, or the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise OutputError("unknown kind of mesh file", where=path, expected=" ".join(MESH_SUFFIXES))
    if len(mesh.faces) == 0:
        raise OutputError("the mesh has no face", where=path)
    texture = mesh.texture
    if texture is not None and suffix in (".ply", ".obj"):
        write_image(Path(path).with_name(texture.name), texture.image)
    if suffix == ".ply":
        write_tables(path, _tables(mesh), [] if texture is None else [_TEXTURE + texture.name])
    elif suffix == ".glb":
        write_glb(path, mesh, frame)
    elif suffix == ".obj" and texture is not None:
        _write_textured_obj(Path(path), mesh, texture)
    else:
        with atomic_path(path) as temporary, quiet_open3d():
            surface = to_open3d(mesh)
            surface.compute_triangle_normals()
            if not o3d.io.write_triangle_mesh(temporary, surface):
                raise OutputError("Open3D could not write the mesh", where=path)


def _write_textured_obj(path: Path, mesh: TriangleMesh, texture: Texture) -> None:
    """Write OBJ and MTL: Open3D's writer names an image of its own after the temporary file."""
    material = path.with_suffix(".mtl")
    write_text(material, f"newmtl left\nKa 1 1 1\nKd 1 1 1\nmap_Kd {texture.name}\n")
    # OBJ counts from the lower left corner of the image, and vertices from 1.
    uv = np.stack([texture.uv[:, 0], 1 - texture.uv[:, 1]], axis=1)
    normals = mesh.normals
    number = np.repeat(mesh.faces + 1, 2 if normals is None else 3, axis=1)
    corner = " %d/%d" if normals is None else " %d/%d/%d"
    with atomic_path(path) as temporary, temporary.open("w") as stream:
        stream.write(f"mtllib {material.name}\nusemtl left\n")
        for key, values in (("v", mesh.vertices), ("vt", uv), ("vn", normals)):
            if values is not None:
                np.savetxt(stream, values, key + values.shape[1] * " %.7g")
        np.savetxt(stream, number, "f" + 3 * corner)


def check_mesh_formats(formats: Sequence[str]) -> None:
    """Refuse unknown formats, given as suffixes without the dot, before the work is done."""
    unknown = [name for name in formats if f".{name}" not in MESH_SUFFIXES]
    if unknown:
        expected = ", ".join(suffix.lstrip(".") for suffix in MESH_SUFFIXES)
        what = "unknown mesh format"
        raise SettingsError(what, where="--format", got=unknown[0], expected=expected)


def join_meshes(path: StrPath, parts: Sequence[tuple[Path, int, int]]) -> None:
    """Join PLY files, each with its numbers of vertices and faces, into one, atomically."""
    files, vertices, faces = zip(*parts, strict=True)
    starts = np.concatenate([[0], np.cumsum(vertices)[:-1]]).astype(np.int32)

    def tables(element: str) -> Iterator[Table]:
        for file, start in zip(files, starts, strict=True):
            yield _tables(read_mesh(file), int(start))[element]

    write_table_parts(
        path, {"vertex": (sum(vertices), tables("vertex")), "face": (sum(faces), tables("face"))}
    )


@reader
def read_mesh(path: StrPath) -> TriangleMesh:
    """Read a mesh; the suffix of the file (.ply, .obj, .stl or .glb) gives the format.

    Raises:
        FormatError: The file is missing, of an unknown format, truncated, has no faces, or has
            faces that are not triangles or refer to vertices that do not exist.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise FormatError("unknown kind of mesh file", expected=" ".join(MESH_SUFFIXES))
    if suffix == ".ply":
        mesh = _read_ply(path)
    elif Path(path).is_file():
        with quiet_open3d():
            found = o3d.io.read_triangle_mesh(Path(path))
        if not found.has_triangles():
            raise FormatError("the file has no triangles that Open3D can read", where=path)
        normals = np.asarray(found.vertex_normals).astype(np.float32)
        shades = np.asarray(found.vertex_colors)
        rgb = np.rint(shades * 255).astype(np.uint8)
        if suffix == ".glb":
            # Open3D takes the linear colours of glTF as they are: IEC 61966-2-1.
            shades = rgb / 255
            curve = 1.055 * shades ** (1 / 2.4) - 0.055
            curve = np.where(shades <= 0.0031308, 12.92 * shades, curve)
            rgb = np.rint(curve * 255).astype(np.uint8)
        mesh = TriangleMesh(
            vertices=np.asarray(found.vertices).astype(np.float32),
            faces=np.asarray(found.triangles).astype(np.int32),
            normals=normals if found.has_vertex_normals() else None,
            rgb=rgb if found.has_vertex_colors() else None,
        )
    else:
        raise FormatError("no such file")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        what, got = "a face refers to a vertex that does not exist", f"{int(mesh.faces.max())}"
        raise FormatError(what, got=got, expected=f"less than {len(mesh.vertices)}")
    if not np.isfinite(mesh.vertices).all():
        raise FormatError("a vertex of the mesh is not finite")
    return mesh


def _tables(mesh: TriangleMesh, start: int = 0) -> dict[str, Table]:
    """Return the two tables of a PLY mesh, with ``start`` added to the indices of its faces."""
    columns = columns_of(mesh, "ply")
    if mesh.texture is not None:
        columns |= {"s": mesh.texture.uv[:, 0], "t": 1 - mesh.texture.uv[:, 1]}
    name = _INDICES[0]
    faces = np.zeros(len(mesh.faces), [(name + LIST_LENGTH, "u1"), (name, "<i4", (3,))])
    faces[name + LIST_LENGTH] = 3
    faces[name] = mesh.faces + np.int32(start)
    return {"vertex": table_of(mesh.vertices, columns), "face": faces}


def _read_ply(path: StrPath) -> TriangleMesh:
    _, tables = read_tables(path, ["vertex", "face"])
    vertex, face = tables.get("vertex"), tables.get("face", np.zeros(0))
    name = next((name for name in _INDICES if name in (face.dtype.names or ())), None)
    if vertex is None or name is None or len(face) == 0:
        raise FormatError("the PLY file has no faces: it is a point cloud")
    faces = face[name].astype(np.int32)
    return TriangleMesh(positions_in(vertex), faces, **attributes_in(vertex, "normals", "rgb"))


def write_glb(path: StrPath, mesh: TriangleMesh, frame: Frame | None = None) -> None:
    """Write a GLB with float vertices; its node is turned to glTF's y up if the frame is known.

    Colours of glTF are linear: sRGB is converted, to 16 bits to keep dark tones distinct.

    Ref: Khronos Group, "glTF 2.0 specification", sections 3.6 (buffers), 3.7 (meshes), 4.4 (GLB).
    """
    vertices: dict[str, NDArray[Any]] = {"POSITION": mesh.vertices}
    if mesh.normals is not None:
        vertices["NORMAL"] = mesh.normals
    if mesh.texture is not None:
        # Colours of vertices would darken it.
        vertices["TEXCOORD_0"] = mesh.texture.uv
    elif mesh.rgb is not None:
        vertices["COLOR_0"] = _linear(mesh.rgb)
    arrays = [*vertices.values(), mesh.faces.astype(np.uint32).reshape(-1, 1)]
    views, accessors = _described(arrays)
    blocks = [values.tobytes() for values in arrays]
    surface, images = dict(_MATTE), {}
    if mesh.texture is not None:
        blocks.append(encode_image(mesh.texture.image, ".png", path))
        start = sum(len(block) for block in blocks[:-1])
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(blocks[-1])})
        images = {
            "images": [{"bufferView": len(views) - 1, "mimeType": "image/png"}],
            "textures": [{"source": 0}],
        }
        surface["baseColorTexture"] = {"index": 0}
    # glTF requires the bounding box of the positions.
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    accessors[0] |= {"min": low.tolist(), "max": high.tolist()}
    attributes = {name: number for number, name in enumerate(vertices)}
    primitive = {"attributes": attributes, "indices": len(vertices), "material": 0}
    coloured = mesh.texture is not None or mesh.rgb is not None
    unlit: dict[str, Any] = {"extensions": {_UNLIT: {}}} if coloured else {}
    # Column by column, in metres.
    turn = {} if frame is None else {"matrix": T_YUP_FRAME[frame].T.ravel().tolist()}
    document = (
        {
            "asset": {"version": "2.0", "generator": "recon"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0} | turn],
            "meshes": [{"primitives": [primitive]}],
            "materials": [{"doubleSided": True, "pbrMetallicRoughness": surface} | unlit],
            "buffers": [{"byteLength": sum(len(block) for block in blocks)}],
            "bufferViews": views,
            "accessors": accessors,
        }
        | images
        | ({"extensionsUsed": [_UNLIT]} if unlit else {})
    )
    head = _chunk(b"JSON", json.dumps(document).encode(), b" ")
    body = _chunk(b"BIN\0", b"".join(blocks), b"\0")
    length = 12 + len(head) + len(body)
    write_bytes(path, struct.pack("<4sII", b"glTF", 2, length) + head + body)


def _linear(rgb: UInt8) -> NDArray[np.uint16]:
    """Return uint16 (V, 4): linear red, green, blue and full opacity (IEC 61966-2-1)."""
    ratio = rgb / 255
    curve = np.where(ratio <= 0.04045, ratio / 12.92, ((ratio + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.rint(np.insert(curve, 3, 1.0, axis=1) * 65535), dtype=np.uint16)


def _described(arrays: list[NDArray[Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return views and accessors: where each array lies in the block of bytes, and its form."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for view, values in enumerate(arrays):
        size, kind = values.nbytes, values.dtype.name
        target = _INDEX_BUFFER if kind == "uint32" else _VERTEX_BUFFER
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": size, "target": target})
        shape = {"bufferView": view, "componentType": _COMPONENTS[kind], "count": len(values)}
        form = {"type": _KINDS[values.shape[1]], "normalized": kind == "uint16"}
        accessors.append(shape | form)
        offset += size
    return views, accessors


def _chunk(kind: bytes, content: bytes, filler: bytes) -> bytes:
    content += filler * (-len(content) % 4)
    return struct.pack("<I4s", len(content), kind) + content


o3d = Lazy("open3d")


def to_open3d(shape: Any) -> Any:
    """Return a mesh or a cloud as Open3D's, with its normals and colours."""
    is_mesh, geometry = isinstance(shape, TriangleMesh), o3d.geometry
    if is_mesh:
        made, of = _surface(shape.vertices, shape.faces), "vertex_"
    else:
        made, of = geometry.PointCloud(_vectors(shape.xyz)), ""
    if shape.normals is not None:
        setattr(made, f"{of}normals", _vectors(shape.normals))
    if shape.rgb is not None:
        setattr(made, f"{of}colors", _vectors(shape.rgb / 255))
    return made


def decimate(
    vertices: NDArray[Any], faces: NDArray[Any], target_faces: int
) -> tuple[Float32, Int32]:
    """Collapse edges until about ``target_faces`` are left (Garland & Heckbert, 1997)."""
    with quiet_open3d():
        smaller = _surface(vertices, faces).simplify_quadric_decimation(
            target_faces, boundary_weight=3.0
        )
    if not smaller.has_triangles():
        got = f"target of {counted(target_faces, 'face')}"
        raise MeshingError("decimation left no face", got=got)
    vertices, faces = np.asarray(smaller.vertices), np.asarray(smaller.triangles)
    return vertices.astype(np.float32), faces.astype(np.int32)


def _surface(vertices: NDArray[Any], faces: NDArray[Any]) -> Any:
    """Return an Open3D mesh of copies; it accepts neither read-only nor float32 arrays."""
    return o3d.geometry.TriangleMesh(
        _vectors(vertices), o3d.utility.Vector3iVector(np.array(faces, dtype=np.int32))
    )


def _vectors(values: NDArray[Any]) -> Any:
    return o3d.utility.Vector3dVector(np.array(values, dtype=np.float64))


_IDENTITY: Final = np.eye(4)
_SENSOR_MM: Final = 36.0  # width of the sensor of MeshLab's cameras; only ratios to it matter


@dataclass(frozen=True)
class Photo:
    """The image of a camera."""

    file: Path
    camera: RectifiedCamera
    # float64 (4, 4), its pose in the frame of the layers; else it is at their origin
    T_frame_camera: Float64 = field(default_factory=lambda: np.eye(4))


def write_mlp(
    path: StrPath,
    layers: Mapping[str, StrPath],
    frame: Frame | None = None,
    photos: Sequence[Photo] = (),
) -> None:
    """Write a MeshLab project of layers (label and existing file), atomically.

    Paths are relative to it. MeshLab opens it with y up and looks along -z: layers are turned if
    their frame is known.
    """
    T = _IDENTITY if frame is None else T_YUP_FRAME[frame]
    project = ET.Element("MeshLabProject")
    group = ET.SubElement(project, "MeshGroup")
    for label, file in layers.items():
        layer = {"label": label, "filename": _relative(file, Path(path)), "visible": "1"}
        ET.SubElement(ET.SubElement(group, "MLMesh", layer), "MLMatrix44").text = _rows(T)
    rasters = ET.SubElement(project, "RasterGroup")
    for photo in photos:
        _add_photo(rasters, photo, T, Path(path))
    ET.indent(project, " ")
    body = ET.tostring(project, encoding="unicode")
    write_text(path, f"<!DOCTYPE MeshLabDocument>\n{body}\n")


def _add_photo(group: ET.Element, photo: Photo, T: Float64, project: Path) -> None:
    """Add a raster layer: an image, and where MeshLab's camera has to stand to see it."""
    camera = photo.camera
    pixel_mm = _SENSOR_MM / camera.width_px
    raster = ET.SubElement(group, "MLRaster", {"label": photo.file.stem})
    # MeshLab counts from the lower left corner of the image, and cameras look along -z. It takes
    # the position of the camera with the other sign.
    T_world_camera = T @ photo.T_frame_camera @ T_YUP_FRAME["camera"].T
    R_camera_world = make_transform(T_world_camera[:3, :3].T, np.zeros(3))
    lens = {
        "TranslationVector": " ".join(f"{x:.10g}" for x in (*(0 - T_world_camera[:3, 3]), 1)),
        "RotationMatrix": " ".join(_rows(R_camera_world).split()),
        "FocalMm": f"{camera.focal_px * pixel_mm:.10g}",
        "PixelSizeMm": f"{pixel_mm:.10g} {pixel_mm:.10g}",
        "ViewportPx": f"{camera.width_px} {camera.height_px}",
        "CenterPx": f"{camera.cx_px + 0.5:.10g} {camera.height_px - 0.5 - camera.cy_px:.10g}",
    }
    plain = {"LensDistortion": "0 0", "CameraType": "0", "BinaryData": "0"}
    ET.SubElement(raster, "VCGCamera", lens | plain)
    ET.SubElement(raster, "Plane", {"semantic": "1", "fileName": _relative(photo.file, project)})


def _rows(T: Float64) -> str:
    return "\n" + "".join(" ".join(f"{x:.10g}" for x in row) + " \n" for row in T)


def _relative(file: StrPath, project: Path) -> str:
    if not Path(file).is_file():
        raise OutputError(
            "a layer of the MeshLab project does not exist", where=file, hint="write it first"
        )
    return Path(os.path.relpath(resolved(file), resolved(project).parent)).as_posix()
