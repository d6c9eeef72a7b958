"""Validation of array fields: dtype and shape are checked, and the array becomes read-only.

Values with such fields become trees of arrays and plain values, and arrays are read from them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from recon.core.errors import ShapeError

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int8 = NDArray[np.int8]
UInt8 = NDArray[np.uint8]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]


def frozen_array(
    name: str, value: Any, dtype: DTypeLike, shape: tuple[int | None, ...]
) -> NDArray[Any]:
    """Check an array without converting it, and return a read-only view; length None is any."""
    if not isinstance(value, np.ndarray):
        got, expected = type(value).__name__, _field_text(dtype, shape)
        raise ShapeError(f"{name} is not an array", got=got, expected=expected)
    fits = len(value.shape) == len(shape) and all(
        want is None or want == have for want, have in zip(shape, value.shape, strict=True)
    )
    if value.dtype != np.dtype(dtype) or not fits:
        raise ShapeError(
            f"{name} has the wrong dtype or shape",
            got=f"{value.dtype.name} {value.shape}",
            expected=_field_text(dtype, shape),
        )
    view: NDArray[Any] = value.view()
    view.flags.writeable = False
    return view


def freeze(instance: object, name: str, dtype: DTypeLike, shape: tuple[int | None, ...]) -> None:
    """Check a field of a frozen dataclass and replace it by a read-only view; None is accepted."""
    value = getattr(instance, name)
    if value is not None:
        label = f"{type(instance).__name__}.{name}"
        object.__setattr__(instance, name, frozen_array(label, value, dtype, shape))


def tree_of(value: Any) -> Any:
    """Return a dataclass or named tuple, and those in it, as mappings of their fields; else it."""
    if is_dataclass(value):
        return {field.name: tree_of(getattr(value, field.name)) for field in fields(value)}
    return value._asdict() if hasattr(value, "_asdict") else value


def array_in(
    tree: Mapping[str, Any], name: str, dtype: DTypeLike, shape: tuple[int | None, ...]
) -> NDArray[Any]:
    """Return an array of a tree that was read, which may be written; floats are finite."""
    values: NDArray[Any] = tree[name]
    if not np.isfinite(frozen_array(name, values, dtype, shape)).all():
        raise ShapeError(f"{name} is not finite")
    return values


def float_map(name: str, values: ArrayLike, shape: tuple[int, ...] | None = None) -> Float32:
    """Convert real numbers to float32 (H, W), masked ones to NaN; with a ``shape`` also ()."""
    try:
        given = values if isinstance(values, np.ma.MaskedArray) else np.asarray(values)
    except ValueError as error:  # rows of different lengths
        raise ShapeError(f"{name} is not an array", got=error) from error
    if given.dtype.kind not in "fiu":
        raise ShapeError(f"{name} is not an array of real numbers", got=f"dtype {given.dtype}")
    fits = given.ndim == 2 if shape is None else given.shape in ((), shape)
    if not fits or given.size == 0:
        expected = "(H, W)" if shape is None else f"{shape}, or one number"
        raise ShapeError(f"{name} has the wrong shape", got=given.shape, expected=expected)
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite
        floats = given.astype(np.float32)
    return np.asarray(np.ma.filled(floats, np.nan) if np.ma.isMaskedArray(floats) else floats)


def size_text(image: NDArray[Any]) -> str:
    """Return width x height."""
    return f"{image.shape[1]}x{image.shape[0]}"


def range_text(values: Float32) -> str:
    """Return the range of the finite values of a map in pixels, for a ``repr``; "" = none."""
    finite = values[np.isfinite(values)]
    return f"{finite.min():.4g} to {finite.max():.4g} px, " if finite.size else ""


def extent_text(xyz: NDArray[Any]) -> str:
    """Return the range of points (N, 3) along each axis in metres, for a ``repr``."""
    if not len(xyz):
        return "empty"
    ends = zip("xyz", xyz.min(axis=0), xyz.max(axis=0), strict=True)
    return ", ".join(f"{axis} {low:.4g} to {high:.4g}" for axis, low, high in ends) + " m"


def _field_text(dtype: DTypeLike, shape: tuple[int | None, ...]) -> str:
    names = iter("NMKL")
    lengths = ", ".join(next(names) if n is None else str(n) for n in shape)
    return f"{np.dtype(dtype).name} ({lengths})"
