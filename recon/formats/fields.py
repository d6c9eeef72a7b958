"""Numbers out of nested mappings, as YAML gives them, each checked and named where it is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from recon.errors import FormatError
from recon.formats.files import StrPath
from recon.structures.arrays import Float64


class Fields:
    """A mapping of a file.

    Args:
        values: The mapping.
        path: Its file, named in errors.
        prefix: Where in the file the mapping stands, such as ``left.``.
    """

    def __init__(self, values: Mapping[str, Any], path: StrPath, prefix: str = "") -> None:
        self._values, self._path, self._prefix = values, path, prefix

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def get(self, name: str) -> Any:
        """What stands there, whatever it is.

        Raises:
            FormatError: Nothing stands there; all of the methods raise this.
        """
        if name not in self._values:
            got = ", ".join(str(key) for key in self._values) or "nothing"
            raise FormatError(
                f"calibration has no {self._prefix + name!r}", where=self._path, got=got
            )
        return self._values[name]

    def below(self, name: str) -> Fields:
        """The mapping that stands there."""
        value = self.get(name)
        if not isinstance(value, Mapping):
            raise self._wrong(name, value, "a mapping")
        return Fields(value, self._path, f"{self._prefix}{name}.")

    def text(self, name: str) -> str:
        """The text that stands there."""
        return str(self.get(name))

    def numbers(self, name: str, shape: tuple[int, ...] | None = None) -> Float64:
        """float64 of that shape; None = a list of any length."""
        value = self.get(name)
        try:
            # Text too: PyYAML takes 1e-05, without a dot, for text.
            array = np.array(value, dtype=np.str_).astype(np.float64)
        except (TypeError, ValueError) as error:
            raise self._wrong(name, value, "numbers") from error
        if not np.isfinite(array).all():
            raise self._wrong(name, value, "finite numbers")
        if shape is None:
            return array.ravel()
        if array.size != np.prod(shape):
            raise self._wrong(name, f"{array.size} numbers", f"{int(np.prod(shape))} numbers")
        return array.reshape(shape)

    def number(self, name: str) -> float:
        """One number."""
        return float(self.numbers(name, (1,))[0])

    def count(self, name: str) -> int:
        """One whole number, above zero."""
        value = self.number(name)
        if value != int(value) or value < 1:
            raise self._wrong(name, value, "a whole number above 0")
        return int(value)

    def _wrong(self, name: str, got: Any, expected: str) -> FormatError:
        return FormatError(
            f"{self._prefix + name!r} is wrong",
            where=self._path,
            got=str(got)[:60],
            expected=expected,
        )
