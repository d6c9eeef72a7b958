"""Validation of array fields: dtype and shape are checked, and the array becomes read-only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from recon.errors import ShapeError

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]
Int32 = NDArray[np.int32]
Bool = NDArray[np.bool_]


def frozen_array(
    name: str, value: Any, dtype: DTypeLike, shape: tuple[int | None, ...]
) -> NDArray[Any]:
    """Check an array and return a read-only view of it.

    Args:
        name: Name used in the error message.
        value: Array to check; never converted, so float64 in place of float32 is an error.
        dtype: Required dtype.
        shape: Required shape; ``None`` stands for any length.

    Raises:
        ShapeError: ``value`` is not an array, or has the wrong dtype or shape.
    """
    expected = f"{np.dtype(dtype).name} {_shape_text(shape)}"
    if not isinstance(value, np.ndarray):
        raise ShapeError(f"{name} is not an array", got=type(value).__name__, expected=expected)
    fits = len(value.shape) == len(shape) and all(
        want is None or want == have for want, have in zip(shape, value.shape, strict=True)
    )
    if value.dtype != np.dtype(dtype) or not fits:
        raise ShapeError(
            f"{name} has the wrong dtype or shape",
            got=f"{value.dtype.name} {value.shape}",
            expected=expected,
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


def _shape_text(shape: tuple[int | None, ...]) -> str:
    names = iter("NMKL")
    return "(" + ", ".join(next(names) if n is None else str(n) for n in shape) + ")"
