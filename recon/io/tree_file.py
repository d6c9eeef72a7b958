"""Trees of arrays and plain values in one file, for the checkpoints of a run.

A zip of ``.npy`` files and one JSON file. The format is private to this project.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError
from recon.io.atomic import atomic_path
from recon.io.files import reader

_TEXT: Final = "tree.json"
_ARRAY: Final = "array"


def write_tree(path: str | PathLike[str], tree: Mapping[str, Any]) -> None:
    """Write a tree of mappings and lists of arrays, numbers (including NaN), strings and None.

    Args:
        path: The file, written atomically.
        tree: Keys are strings. Tuples are read back as lists.

    Raises:
        OutputError: The file cannot be written.
    """
    arrays: list[np.ndarray[Any, Any]] = []
    text = json.dumps(_without_arrays(tree, arrays))
    # Not compressed: sums of measurements would shrink by a third and take twenty times as long.
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as file:
        file.writestr(_TEXT, text)
        for number, array in enumerate(arrays):
            with file.open(f"{number}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, _in_order(array), allow_pickle=False)


@reader
def read_tree(path: str | PathLike[str]) -> dict[str, Any]:
    """Read what `write_tree` wrote.

    Raises:
        FormatError: The file is missing, damaged or of another kind.
    """
    with zipfile.ZipFile(Path(path)) as file:
        tree = _with_arrays(json.loads(file.read(_TEXT)), file)
    if not isinstance(tree, dict):
        raise FormatError("the state is not a tree", where=path)
    return tree


def _in_order(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The array in its own order of axes: products of matrices round differently in another."""
    return array if array.flags.f_contiguous else np.ascontiguousarray(array)


def _without_arrays(value: Any, arrays: list[np.ndarray[Any, Any]]) -> Any:
    """Replace each array by ``{"array": n}`` and append it to ``arrays``."""
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {_ARRAY: len(arrays) - 1}
    if isinstance(value, Mapping):
        return {"tree": {name: _without_arrays(item, arrays) for name, item in value.items()}}
    if isinstance(value, list | tuple):
        return [_without_arrays(item, arrays) for item in value]
    return value


def _with_arrays(value: Any, file: zipfile.ZipFile) -> Any:
    if isinstance(value, list):
        return [_with_arrays(item, file) for item in value]
    if not isinstance(value, dict):
        return value
    if _ARRAY in value:
        with file.open(f"{value[_ARRAY]}.npy") as stream:
            return np.lib.format.read_array(stream, allow_pickle=False)
    return {name: _with_arrays(item, file) for name, item in value["tree"].items()}
