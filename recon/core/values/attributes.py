"""What a point may carry beside its position: a row for each attribute, which code loops over.

A field of its name in `PointCloud` is what users see of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Float32

Format = Literal["ply", "pcd", "las", "e57", "ros"]


@dataclass(frozen=True)
class Attribute:
    """An attribute of a point: its form, how many values become one, and what others call it.

    Attributes:
        name: Field of `PointCloud`.
        dtype: Of its numbers.
        width: Numbers of a point: 1 = an array (N,), else (N, width).
        unit: Of its numbers, for people.
        fused: How the values of many points become one, in a voxel of a map or of a filter:
            ``mean``; ``direction``, a mean of unit length, which turns with the cloud; ``vote``,
            the value with most weight; ``own``: fusion finds it, a filter takes the mean; None: it
            is unknown then.
        values: Of a vote: how many there are, from 0.
        bounds: Least and largest value; a column of a file with others is something else.
        ply, pcd, las, e57, ros: Its columns in files (ROS: PointCloud2); none = not written. Three
            bytes with one name are packed into the bits of a float, 0x00RRGGBB.
        about: What it is, where LAS has room for 32 letters.
        view: What the viewer calls a colouring by it; none = it shows none.
        scale: The colours of it there; none = it is a colour.
    """

    name: str
    dtype: type[np.generic]
    width: int = 1
    unit: str = ""
    fused: Literal["mean", "direction", "vote", "own"] | None = None
    values: int = 0
    bounds: tuple[float, float] | None = None
    ply: tuple[str, ...] = ()
    pcd: tuple[str, ...] = ()
    las: tuple[str, ...] = ()
    e57: tuple[str, ...] = ()
    ros: tuple[str, ...] = ()
    about: str = ""
    view: str = ""
    scale: str = ""

    @property
    def columns(self) -> int:
        """How many numbers of a point are averaged: those of a vote are one for each value."""
        return self.values or self.width

    def shape(self, points: int) -> tuple[int, ...]:
        return (points,) if self.width == 1 else (points, self.width)

    def averaged(self, values: NDArray[Any]) -> Float32:
        """Return float32 (N, columns), numbers whose weighted mean has the value of many points."""
        if self.fused == "vote":
            return np.asarray(values[:, None] == np.arange(self.values), np.float32)
        return values.reshape(len(values), self.width).astype(np.float32, copy=False)

    def of_means(self, means: NDArray[Any]) -> NDArray[Any]:
        """Return the values of means (N, columns) of what `averaged` gave."""
        if self.fused == "vote":
            means = means.argmax(axis=1)
        elif self.fused == "direction":
            length = np.linalg.norm(means, axis=1, keepdims=True)
            means = means / np.maximum(length, np.float32(1e-12))
        elif np.issubdtype(self.dtype, np.integer):
            means = np.rint(means)
        return np.asarray(means, self.dtype).reshape(self.shape(len(means)))


#: In the order of columns in files.
ATTRIBUTES: Final = (
    Attribute(
        "normals", np.float32, 3, fused="direction",
        ply=("nx", "ny", "nz"), pcd=("normal_x", "normal_y", "normal_z"),
    ),
    Attribute(
        "rgb", np.uint8, 3, fused="mean", view="image",
        ply=("red", "green", "blue"), las=("red", "green", "blue"), pcd=("rgb",), ros=("rgb",),
        e57=("colorRed", "colorGreen", "colorBlue"),
    ),
    Attribute(
        "confidence", np.float32, fused="mean", bounds=(0.0, 1.0),
        ply=("quality",), pcd=("confidence",),  # MeshLab shows `quality`
    ),
    Attribute(
        "sigma_m", np.float32, unit="m", fused="own", about="depth, 1 sigma, metres",
        ply=("sigma",), pcd=("sigma",), las=("sigma",), ros=("sigma",),
        view="sigma", scale="viridis",
    ),
    Attribute(
        "inferred", np.uint8, fused="mean", bounds=(0, 1), about="1 = inferred, 0 = measured",
        ply=("inferred",), pcd=("inferred",), las=("inferred",), ros=("inferred",),
        view="inferred", scale="tab10",
    ),
    Attribute("weight", np.float32, fused="own", ply=("weight",)),
    Attribute("count", np.int32, fused="own", ply=("count",)),
    Attribute("time_s", np.float32, unit="s", ply=("time_s",), view="age", scale="viridis"),
    Attribute("session", np.int32, ply=("session",), view="session", scale="tab10"),
)  # fmt: skip
