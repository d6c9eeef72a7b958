"""YAML, TOML and JSON files, and typed access to their fields, in errors that name the field."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from itertools import accumulate
from typing import Any, Final

import numpy as np
import yaml

from recon.core.errors import FormatError, OutputError
from recon.core.text import counted, is_count, parse_integer, parse_number, parse_numbers
from recon.core.values.arrays import Float64
from recon.io.atomic import write_text
from recon.io.files import SMALL_FILE_BYTES, StrPath, read_text, reading

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

#: More values than any calibration has; an alias can repeat a list of lists of … without end.
_MOST_VALUES: Final = 1_000_000
_DEEPEST: Final = 100
_BRACKET: Final = re.compile(r"[\[\]{}]")
# The line break stays, so that errors name the right line.
_OPENCV_HEADER: Final = re.compile(r"\A%YAML:\s*1\.\d.*")
_OPENCV_TAG: Final = re.compile(r"!!opencv-[a-z-]+")


class Fields:
    """A mapping from a file, for use inside of `reading`; ``prefix`` is its path (``left.``)."""

    def __init__(self, values: Mapping[str, Any], prefix: str = "") -> None:
        self._values, self._prefix = values, prefix

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def get(self, name: str) -> Any:
        if name not in self._values:
            got = ", ".join(str(key) for key in self._values) or "nothing"
            raise FormatError(f"calibration has no {self._prefix + name!r}", got=got)
        return self._values[name]

    def below(self, name: str) -> Fields:
        value = self.get(name)
        if not isinstance(value, Mapping):
            raise self._wrong(name, value, "a mapping")
        return Fields(value, f"{self._prefix}{name}.")

    def text(self, name: str) -> str:
        return str(self.get(name))

    def numbers(self, name: str, shape: tuple[int, ...] | None = None) -> Float64:
        """Return float64 of that shape (None = a list); a text such as ``[1 0; 0 1]`` is split."""
        value = self.get(name)
        parts = value.strip("[] ").replace(";", " ").split() if isinstance(value, str) else value
        try:
            array = numbers_of(parts)
        except (TypeError, ValueError) as error:
            raise self._wrong(name, value, "numbers") from error
        if not np.isfinite(array).all():
            raise self._wrong(name, value, "finite numbers")
        if shape is None:
            return array.ravel()
        size = int(np.prod(shape))
        if array.size != size:
            raise self._wrong(name, counted(array.size, "number"), counted(size, "number"))
        return array.reshape(shape)

    def number(self, name: str) -> float:
        return float(self.numbers(name, (1,))[0])

    def count(self, name: str) -> int:
        value = self.number(name)
        if value != int(value) or value < 1:
            raise self._wrong(name, value, "a positive integer")
        return int(value)

    def _wrong(self, name: str, got: Any, expected: str) -> FormatError:
        what = f"{self._prefix + name!r} is wrong"
        return FormatError(what, got=str(got)[:60], expected=expected)


def numbers_of(value: Any) -> Float64:
    """Return a number or text, or lists of them, as float64 of that shape."""
    words = np.array(value, dtype=np.str_)
    return np.array(parse_numbers(words.ravel().tolist())).reshape(words.shape)


def read_yaml(path: StrPath) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping; OpenCV's header and tags are permitted."""
    content = parse_yaml(plain_yaml(read_text(path, SMALL_FILE_BYTES)), path)
    if not isinstance(content, dict):
        raise FormatError("YAML file is not a mapping", where=path, got=type(content).__name__)
    return {str(key): value for key, value in content.items()}


def plain_yaml(text: str) -> str:
    """Return the text without what makes OpenCV's dialect invalid YAML: header and matrix tags."""
    return _OPENCV_TAG.sub("", _OPENCV_HEADER.sub("", text))


def parse_yaml(text: str, where: StrPath) -> Any:
    """Parse YAML into plain values."""
    with reading(where):
        if _depth(text) > _DEEPEST:
            raise FormatError("content is nested too deeply")
        try:
            content = _Loader(text).get_single_data()
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None)
            place = f"{where}:{mark.line + 1}" if mark is not None else where
            raise FormatError("not a YAML file", where=place) from error
        if _count(content, {}) > _MOST_VALUES:
            raise FormatError("aliases expand to too many values")
        return content


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


def write_json(path: StrPath, values: Mapping[str, Any]) -> None:
    """Write a JSON file atomically; NaN is refused, since it is not valid JSON."""
    text = json.dumps(values, indent=2, allow_nan=False, ensure_ascii=False)
    write_text(path, text + "\n")


def write_yaml(path: StrPath, values: Mapping[str, Any]) -> None:
    """Write plain values as YAML, in their order, atomically."""
    try:
        text = yaml.safe_dump(dict(values), sort_keys=False, allow_unicode=True)
    except yaml.YAMLError as error:
        raise OutputError("value cannot be written as YAML", where=path, got=str(error)) from error
    write_text(path, text)


def read_toml(path: StrPath) -> dict[str, Any]:
    """Read a TOML file."""
    text = read_text(path, SMALL_FILE_BYTES)
    with reading(path):
        try:
            return dict(tomllib.loads(text))
        except tomllib.TOMLDecodeError as error:
            raise FormatError("not a TOML file", got=error) from error
