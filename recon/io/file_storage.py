"""Files of OpenCV's ``FileStorage``: YAML, XML or JSON.

OpenCV's own parser is not used: on content from outside it overflows its stack, does not end, or
allocates whatever size a matrix claims.
"""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any, Final

from recon.core.errors import FormatError
from recon.core.values.arrays import Float64
from recon.io.fields import numbers_of
from recon.io.files import SMALL_FILE_BYTES, StrPath, read_text, reader
from recon.io.yaml_file import parse_yaml, plain_yaml

_NOT_FINITE: Final = re.compile(r"\.(?:Nan|Inf)\b")
_XML_ROOT: Final = "opencv_storage"


@reader
def read_file_storage(path: StrPath) -> dict[str, Float64 | str]:
    """Read the numbers and texts at the top level of a file.

    Returns:
        float64 () for a number, (N,) for a list of numbers or the data of a matrix, row by row, and
        text. Anything else is left out.
    """
    text = read_text(path, SMALL_FILE_BYTES)
    try:
        nodes = _parse(text, path)
    except (ET.ParseError, json.JSONDecodeError) as error:
        raise FormatError("not an OpenCV FileStorage file", where=path, got=error) from error
    if not isinstance(nodes, dict):
        raise FormatError("not an OpenCV FileStorage file", where=path)
    values = {str(name): _value(node) for name, node in nodes.items()}
    return {name: value for name, value in values.items() if value is not None}


def _parse(text: str, path: StrPath) -> Any:
    start = text.lstrip()[:1]
    if start == "<":
        return _parse_xml(text)
    if start == "{":
        return json.loads(text)
    # OpenCV capitalises only the first letter of .Nan and .Inf.
    plain = _NOT_FINITE.sub(lambda found: found[0].lower(), plain_yaml(text))
    return parse_yaml(plain, path)


def _value(node: Any) -> Float64 | str | None:
    """Return a number, the numbers of a list or matrix, or a text; None for anything else."""
    if isinstance(node, Mapping):
        return _value(node["data"]) if isinstance(node.get("data"), list) else None
    if isinstance(node, list) and any(isinstance(part, list | dict) for part in node):
        return None
    try:
        return numbers_of(node)
    except ValueError:
        return node if isinstance(node, str) else None


def _parse_xml(text: str) -> dict[str, Any] | None:
    root = ET.fromstring(text.encode())  # noqa: S314 - see the import
    return {node.tag: _xml_node(node) for node in root} if root.tag == _XML_ROOT else None


def _xml_node(element: ET.Element) -> Any:
    """Return a list or text, and a mapping for a matrix."""
    data = element.find("data")
    if data is not None:
        return {"data": (data.text or "").split()}
    words = (element.text or "").split()
    return words if len(words) > 1 else "".join(words).strip('"')
