"""What is in a file of any program: numbers, matrices and texts by their names.

YAML and XML of OpenCV, JSON, INI, arrays of NumPy and MATLAB, and bare numbers. A name below
another is dotted: ``left.projection.fx``.
"""

from __future__ import annotations

import configparser
import json
import re
import xml.etree.ElementTree as ET
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.values.arrays import Float64
from recon.io.fields import numbers_of, parse_yaml, plain_yaml
from recon.io.files import SMALL_FILE_BYTES, StrPath, read_bytes, read_text, reader, refuse_special

Value = Float64 | str
Contents = dict[str, Value]

SAVE: Final = (
    "save the matrices with np.savez('stereo_calib.npz', K1=K1, D1=D1, K2=K2, D2=D2, R=R, T=T, "
    "image_size=(width, height))"
)
"""What to do with numbers that are in a pickle, or in none of the known files."""
_NOT_FINITE: Final = re.compile(r"\.(?:Nan|Inf)\b")
_TIGHT: Final = re.compile(r"^([A-Za-z][\w.]*):(?=[^\s/])", re.MULTILINE)  # ``size:2`` of OpenCV
_SECTION: Final = re.compile(r"\A\s*\[\w+\]\s*$", re.MULTILINE)
#: How names of files end that are no text; the first are pickles.
BINARY: Final = (".pkl", ".pickle", ".p", ".npz", ".npy", ".mat")
_PICKLE: Final = "a pickle runs the code that is in it, and is not read"
_REFUSED: Final = {  # by how a file begins
    b"\x80": _PICKLE,
    b"\x89HDF": "a file of HDF5 is no calibration that is read",
    b"\x93NUMPY": "one array of NumPy is no calibration of a pair",
}
_XML_ROOT: Final = "opencv_storage"
# Of MATLAB's files: kinds of elements and variables, and the most bytes of what is compressed.
_COMPRESSED, _STRUCTURE, _CHARACTERS, _OBJECT, _MOST_OF_MATLAB = 15, 2, 4, 17, 1 << 24
_NUMBERS: Final = {
    1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8",
    13: "<u8", 16: "u1", 17: "<u2",
}  # fmt: skip
_MOST_BYTES: Final = 1 << 20  # of an array: more than a matrix has, less than tables of a remap
_VECTORS: Final = {frozenset(names): names for names in (
    ("x", "y", "z"), ("x", "y", "z", "w"), ("px", "py", "pz", "qx", "qy", "qz", "qw"),
)}  # fmt: skip


@reader
def read_contents(path: StrPath) -> Contents:
    """Read all numbers, float64 of any shape, and texts of a file; maps and objects are left out.

    Raises:
        FormatError: The file is damaged or too large, or a pickle, which is never loaded.
    """
    refuse_special(path)
    with Path(path).open("rb") as file:
        head = file.read(128)
    if head.startswith(b"PK\x03\x04"):
        return dict(_flat(_read_arrays(path)))
    if head.startswith(b"MATLAB"):
        return dict(_flat(dict(_read_matlab(read_bytes(path, SMALL_FILE_BYTES)))))
    refused = [what for sign, what in _REFUSED.items() if head.startswith(sign)]
    if refused or Path(path).suffix in BINARY[:3]:
        raise FormatError((*refused, _PICKLE)[0], hint=f"load it where it was written, and {SAVE}")
    return dict(_flat(_parse(read_text(path, SMALL_FILE_BYTES), path)))


def _parse(text: str, path: StrPath) -> Any:
    """Return what a text says, as plain values."""
    start = text.lstrip()[:1]
    # OpenCV's own parser overflows its stack, does not end, or allocates what a matrix claims.
    try:
        if start == "<":
            root = ET.fromstring(text.encode())  # noqa: S314 - see the import
            return {node.tag: _xml_node(node) for node in root} if root.tag == _XML_ROOT else None
        if start == "{":
            return json.loads(text)
        if _SECTION.match(text):
            parser = configparser.ConfigParser(strict=False, interpolation=None)
            parser.optionxform = str  # type: ignore[assignment, method-assign]
            parser.read_string(text)
            return {name: dict(parser[name]) for name in parser.sections()}
    except (ET.ParseError, json.JSONDecodeError, configparser.Error) as error:
        raise FormatError("not a file of calibrations", got=str(error)[:120]) from error
    words = text.split()
    if len(words) in (9, 10) and not re.search(r"[^\d\s.eE+-]", text):
        return {"K": words[:9], "baseline": words[9:] or None}
    # OpenCV capitalises only the first letter of .Nan and .Inf.
    plain = _NOT_FINITE.sub(lambda found: found[0].lower(), plain_yaml(text))
    return parse_yaml(_TIGHT.sub(r"\1: ", plain), path)


def _xml_node(element: ET.Element) -> Any:
    data = element.find("data")
    if data is not None:
        return {"data": (data.text or "").split()}
    words = (element.text or "").split()
    return words if len(words) > 1 else "".join(words).strip('"')


def _read_arrays(path: StrPath) -> dict[str, Any]:
    """Return the small arrays of an archive of NumPy; a pickled one is never loaded."""
    arrays: dict[str, Any] = {}
    with zipfile.ZipFile(path) as archive:
        for each in archive.infolist():
            if each.file_size > _MOST_BYTES or not each.filename.endswith(".npy"):
                continue
            try:
                array = np.lib.format.read_array(archive.open(each), allow_pickle=False)
                arrays[each.filename.removesuffix(".npy")] = array
            except ValueError as error:
                if "allow_pickle" not in str(error):
                    raise
    if not arrays:
        what = "archive has no matrices of cameras, but pickled objects, large tables or nothing"
        raise FormatError(what, expected="matrices K1, D1, K2, D2, R, T", hint=SAVE)
    return arrays


def _read_matlab(content: bytes) -> Iterator[tuple[str, Any]]:
    """Yield names and values of variables; SciPy's reader of damaged files ends the process.

    Ref: "MAT-File Format", MathWorks, level 5.
    """
    if not content.startswith(b"MATLAB 5.0") or content[126:128] != b"IM":
        what, got = "this version of MATLAB's files is not read", content[:19].decode("latin-1")
        hint = "in MATLAB: save('stereo.mat', '-struct', 'p', '-v7')"
        raise FormatError(what, got=got, hint=hint)
    left = _MOST_OF_MATLAB
    for kind, part in _elements(memoryview(content)[128:]):
        if kind == _COMPRESSED:
            unpack = zlib.decompressobj()
            inside = memoryview(unpack.decompress(part, left))
            left -= len(inside)
            if unpack.unconsumed_tail or left < 1:
                raise FormatError("a variable is too large for a calibration")
            yield from (_variable(each) for _, each in _elements(inside))
        else:
            yield _variable(part)


def _elements(content: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield kind and data of elements that follow each other."""
    at = 0
    while at + 8 <= len(content):
        kind, size = np.frombuffer(content, "<u4", 2, at).tolist()
        start = at + 8
        if kind >> 16:  # a short one is where others have their size
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
        if start + size > len(content):
            raise FormatError("MATLAB file is truncated or damaged", hint="copy the file again")
        yield kind, content[start : start + size]
        at = start + size + (0 if kind == _COMPRESSED else -(start + size) % 8)


def _variable(content: memoryview) -> tuple[str, Any]:
    """Return name and value of a variable: a structure, a text, or numbers; None = another."""
    (_, flags), *parts = _elements(content)
    if flags[0] == _OBJECT:
        raise FormatError(
            "an object of MATLAB can be read by MATLAB alone",
            hint="in MATLAB: p = toStruct(stereoParams); save('stereo.mat', '-struct', 'p', '-v7')",
        )
    (_, shape), (_, name), *values = parts
    value: Any = None
    if flags[0] == _STRUCTURE:  # of several the first
        (_, longest), (_, names), *fields = values
        width = int.from_bytes(longest, "little")
        starts = range(0, len(names), width)
        keys = [_text(names[at : at + width]) for at in starts]
        value = {key: _variable(field)[1] for key, (_, field) in zip(keys, fields, strict=False)}
    elif values and (kind := _NUMBERS.get(values[0][0])):
        numbers = np.frombuffer(values[0][1], kind)
        sides = np.frombuffer(shape, "<i4")
        value = numbers.reshape(sides, order="F").squeeze()
        if flags[0] == _CHARACTERS:
            value = "".join(map(chr, numbers.tolist()))
    return _text(name), value


def _text(content: memoryview) -> str:
    return bytes(content).partition(b"\0")[0].decode("latin-1")


def _flat(node: Any, name: str = "") -> Iterator[tuple[str, Value]]:
    """Yield names and values below a node."""
    if isinstance(node, Mapping):
        parts = {str(key).lower(): value for key, value in node.items()}
        if isinstance(node.get("data"), list):
            yield from _flat(node["data"], name)
            return
        order = _VECTORS.get(frozenset(parts))
        if order is not None:
            yield from _flat([parts[key] for key in order], name)
            return
        for key, value in node.items():
            yield from _flat(value, f"{name}.{key}" if name else str(key))
    elif isinstance(node, list) and node and isinstance(node[0], Mapping):
        yield from _flat(dict(enumerate(node)), name)
    elif isinstance(node, list) and node and all(_is_item(part) for part in node):
        yield from _flat(dict(node), name)
    elif isinstance(node, np.ndarray):
        if node.dtype.kind in "fiub" and node.size * node.itemsize <= _MOST_BYTES:
            yield name, node.astype(np.float64)
        elif node.dtype.kind == "U" and node.size == 1:
            yield name, str(node.item())
    elif node is not None:
        try:
            yield name, numbers_of(node)
        except ValueError:
            if isinstance(node, str):
                yield name, node


def _is_item(part: Any) -> bool:
    """Return whether a part of a list is a key beside a mapping, as OAK's cameras are listed."""
    return isinstance(part, list) and len(part) == 2 and isinstance(part[1], Mapping)
