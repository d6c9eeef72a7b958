"""What is in a file of any program: numbers, matrices and texts by their names.

YAML and XML of OpenCV, JSON, INI, arrays of NumPy and MATLAB, and bare numbers. A name below
another is dotted: ``left.projection.fx``.
"""

from __future__ import annotations

import configparser
import io
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
        return dict(_flat(_read_matlab(read_bytes(path, SMALL_FILE_BYTES))))
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
        what = "archive has no arrays of numbers, but pickled objects or none"
        raise FormatError(what, expected="matrices K1, D1, K2, D2, R, T", hint=SAVE)
    return arrays


def _read_matlab(content: bytes) -> dict[str, Any]:
    from scipy.io import loadmat  # noqa: PLC0415 - slow, and for these files alone
    from scipy.io.matlab import MatlabOpaque  # noqa: PLC0415

    if not content.startswith(b"MATLAB 5.0"):
        what, got = "this version of MATLAB's files is not read", content[:19].decode("latin-1")
        raise FormatError(
            what, got=got, hint="in MATLAB: save('stereo.mat', '-struct', 'p', '-v7')"
        )
    at = 128
    while at + 8 <= len(content):  # a compressed variable must not become more than a file may have
        kind, size = np.frombuffer(content, "<u4", 2, at).tolist()
        if kind == 15:
            unpack = zlib.decompressobj()
            unpack.decompress(content[at + 8 : at + 8 + size], SMALL_FILE_BYTES)
            if unpack.unconsumed_tail:
                raise FormatError("a variable is too large for a calibration")
        at += 8 + size
    values = loadmat(io.BytesIO(content), simplify_cells=True)
    if any(isinstance(value, MatlabOpaque) for value in values.values()):
        raise FormatError(
            "an object of MATLAB can be read by MATLAB alone",
            hint="in MATLAB: p = toStruct(stereoParams); save('stereo.mat', '-struct', 'p', '-v7')",
        )
    return {name: value for name, value in values.items() if not name.startswith("__")}


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
