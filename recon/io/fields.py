"""Typed access to the fields of a file, from YAML or lines of text; errors name the field."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from recon.core.decimals import parse_numbers
from recon.core.errors import FormatError
from recon.core.values.arrays import Float64
from recon.core.words import counted
from recon.io.files import StrPath


def numbers_of(value: Any) -> Float64:
    """Return a number or text, or lists of them, as float64 of that shape."""
    words = np.array(value, dtype=np.str_)
    return np.array(parse_numbers(words.ravel().tolist())).reshape(words.shape)


class Fields:
    """A mapping read from a file.

    Args:
        values: The mapping.
        path: The file, for error messages.
        prefix: Path of the mapping in the file, such as ``left.``.
    """

    def __init__(self, values: Mapping[str, Any], path: StrPath, prefix: str = "") -> None:
        self._values, self._path, self._prefix = values, path, prefix

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def get(self, name: str) -> Any:
        """Return the value of a field, of any type."""
        if name not in self._values:
            got = ", ".join(str(key) for key in self._values) or "nothing"
            raise FormatError(
                f"calibration has no {self._prefix + name!r}", where=self._path, got=got
            )
        return self._values[name]

    def below(self, name: str) -> Fields:
        """Return the mapping in a field."""
        value = self.get(name)
        if not isinstance(value, Mapping):
            raise self._wrong(name, value, "a mapping")
        return Fields(value, self._path, f"{self._prefix}{name}.")

    def text(self, name: str) -> str:
        """Return the value of a field as text."""
        return str(self.get(name))

    def numbers(self, name: str, shape: tuple[int, ...] | None = None) -> Float64:
        """Return the value as float64 of that shape; None = a list of any length.

        A text is split into its numbers, also where it is a matrix such as ``[1 0; 0 1]``.
        """
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
        if array.size != np.prod(shape):
            raise self._wrong(
                name, counted(array.size, "number"), counted(int(np.prod(shape)), "number")
            )
        return array.reshape(shape)

    def number(self, name: str) -> float:
        """Return the value as one number."""
        return float(self.numbers(name, (1,))[0])

    def count(self, name: str) -> int:
        """Return the value as one positive integer."""
        value = self.number(name)
        if value != int(value) or value < 1:
            raise self._wrong(name, value, "a positive integer")
        return int(value)

    def _wrong(self, name: str, got: Any, expected: str) -> FormatError:
        return FormatError(
            f"{self._prefix + name!r} is wrong",
            where=self._path,
            got=str(got)[:60],
            expected=expected,
        )
