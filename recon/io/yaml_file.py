"""YAML files with settings; for the matrices of OpenCV's dialect see `opencv_yaml`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from itertools import accumulate
from typing import Any, Final

import yaml

from recon.core.decimals import is_count, parse_integer, parse_number
from recon.core.errors import FormatError, OutputError
from recon.io.atomic import write_text
from recon.io.files import SMALL_FILE_BYTES, StrPath, read_text, reading

#: More values than any calibration has; an alias can repeat a list of lists of … without end.
_MOST_VALUES: Final = 1_000_000
_DEEPEST: Final = 100
_BRACKET: Final = re.compile(r"[\[\]{}]")


class _Loader(yaml.SafeLoader):
    """Reads numbers as `parse_number` does; others of YAML 1.1 (1_0, 0x10, 1:30) stay text."""

    def number(self, node: yaml.ScalarNode) -> float | str:
        """Return a whole number, any other number, or the text as it stands."""
        text = str(node.value)
        plain = text.lower().replace(".inf", "inf").replace(".nan", "nan")
        if is_count(plain.lstrip("+-")):
            return parse_integer(plain)  # refuses thousands of digits
        with suppress(ValueError):
            return parse_number(plain)
        return text


for _kind in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _Loader.number)


def parse_yaml(text: str, where: StrPath) -> Any:
    """Parse YAML into plain values."""
    with reading(where):
        if _depth(text) > _DEEPEST:
            raise FormatError("content is nested too deeply", where=where)
        try:
            content = _Loader(text).get_single_data()
        except yaml.YAMLError as error:
            raise FormatError("not a YAML file", where=_place(where, error)) from error
        if _count(content, {}) > _MOST_VALUES:
            raise FormatError("aliases expand to too many values", where=where)
        return content


def _depth(text: str) -> int:
    """Return the most brackets open at once; PyYAML's time grows with their square."""
    steps = (1 if bracket in "[{" else -1 for bracket in _BRACKET.findall(text))
    return max(accumulate(steps), default=0)


def _count(value: Any, known: dict[int, int]) -> int:
    """Return the number of values that a value holds with all its aliases expanded."""
    if not isinstance(value, dict | list):
        return 1
    if id(value) not in known:
        known[id(value)] = _MOST_VALUES + 1  # what it counts if it contains itself
        parts = value.values() if isinstance(value, dict) else value
        known[id(value)] = 1 + sum(_count(part, known) for part in parts)
    return known[id(value)]


# The line break stays, so that errors name the right line.
_OPENCV_HEADER: Final = re.compile(r"\A%YAML:\s*1\.\d.*")
_OPENCV_TAG: Final = re.compile(r"!!opencv-[a-z-]+")


def read_yaml(path: StrPath) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping; OpenCV's header and tags are permitted."""
    content = parse_yaml(plain_yaml(read_text(path, SMALL_FILE_BYTES)), path)
    if not isinstance(content, dict):
        raise FormatError("YAML file is not a mapping", where=path, got=type(content).__name__)
    return {str(key): value for key, value in content.items()}


def write_yaml(path: StrPath, values: Mapping[str, Any]) -> None:
    """Write plain values as YAML, in their order, atomically."""
    try:
        text = yaml.safe_dump(dict(values), sort_keys=False, allow_unicode=True)
    except yaml.YAMLError as error:
        raise OutputError("value cannot be written as YAML", where=path, got=str(error)) from error
    write_text(path, text)


def plain_yaml(text: str) -> str:
    """Return the text without what makes OpenCV's dialect invalid YAML: header and matrix tags."""
    return _OPENCV_TAG.sub("", _OPENCV_HEADER.sub("", text))


def _place(path: StrPath, error: yaml.YAMLError) -> str:
    mark = getattr(error, "problem_mark", None)
    return f"{path}:{mark.line + 1}" if mark is not None else str(path)
