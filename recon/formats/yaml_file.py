"""YAML files with settings; for the matrices of OpenCV's dialect see `opencv_yaml`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

import yaml

from recon.errors import FormatError, OutputError
from recon.formats.atomic import write_text
from recon.formats.files import StrPath, read_text

# The line break stays, so that errors name the right line.
_OPENCV_HEADER: Final = re.compile(r"\A%YAML:\s*1\.\d.*")


def read_yaml(path: StrPath) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping; OpenCV's header and tags are permitted.

    Raises:
        FormatError: The file is missing, not YAML, or not a mapping.
    """
    try:
        content = yaml.safe_load(_plain(read_text(path)))
    except yaml.YAMLError as error:
        raise FormatError("not a YAML file", where=_place(path, error)) from error
    if not isinstance(content, dict):
        raise FormatError("YAML file is not a mapping", where=path, got=type(content).__name__)
    return {str(key): value for key, value in content.items()}


def write_yaml(path: StrPath, values: Mapping[str, Any]) -> None:
    """Write plain values as YAML, in their order, atomically.

    Raises:
        OutputError: A value cannot be written as YAML, or the file cannot be written.
    """
    try:
        text = yaml.safe_dump(dict(values), sort_keys=False, allow_unicode=True)
    except yaml.YAMLError as error:
        raise OutputError("value cannot be written as YAML", where=path, got=str(error)) from error
    write_text(path, text)


def _plain(text: str) -> str:
    """The text without what makes OpenCV's dialect invalid YAML: its header and matrix tags."""
    body, headers = _OPENCV_HEADER.subn("", text)
    return body.replace("!!opencv-matrix", "") if headers else text


def _place(path: StrPath, error: yaml.YAMLError) -> str:
    mark = getattr(error, "problem_mark", None)
    return f"{path}:{mark.line + 1}" if mark is not None else str(path)
