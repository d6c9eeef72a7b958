"""Point clouds with their attributes, a table that code loops over; rays of a frame; meshes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from recon.core.lazy import Shape
from recon.core.text import counted
from recon.core.values.arrays import Float32, Int32, UInt8, extent_text, freeze

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

Frame = Literal["camera", "world", "map"]


@dataclass(frozen=True, eq=False)
class PointCloud(Shape):
    """Points in one frame. Every field but ``xyz`` and ``frame`` may be None (unknown).

    Attributes:
        xyz: float32 (N, 3), metres, finite.
        rgb: uint8 (N, 3).
        normals: float32 (N, 3), unit length, towards the camera that saw the point.
        sigma_m: float32 (N,), standard deviation of the depth (``sigma_z``).
        confidence: float32 (N,) in [0, 1].
        weight: float32 (N,), sum of the weights of the fused measurements.
        count: int32 (N,), number of frames that saw the point; in a thinned frame, number of
            points that it replaces.
        time_s: float32 (N,), when in its drive it was seen, seconds.
        session: int32 (N,), number of the drive that saw it.
        inferred: uint8 (N,), 1 = from planes around its pixel, 0 = measured; None = all measured.
        frame: Frame of ``xyz``: camera (x right, y down, z forward), world (the first rectified
            left camera) or map (x forward, y left, z up).
    """

    xyz: Float32
    rgb: UInt8 | None = None
    normals: Float32 | None = None
    sigma_m: Float32 | None = None
    confidence: Float32 | None = None
    weight: Float32 | None = None
    count: Int32 | None = None
    time_s: Float32 | None = None
    session: Int32 | None = None
    inferred: UInt8 | None = None
    frame: Frame = "camera"

    def __post_init__(self) -> None:
        freeze(self, "xyz", np.float32, (None, 3))
        for each in ATTRIBUTES:
            freeze(self, each.name, each.dtype, each.shape(len(self.xyz)))

    def __repr__(self) -> str:
        _, *known = self.arrays
        parts = (counted(len(self), "point"), extent_text(self.xyz), f"{self.frame} axes", *known)
        return f"PointCloud({', '.join(parts)})"

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The fields that are known, by name: ``xyz`` and its attributes."""
        values = {field.name: getattr(self, field.name) for field in fields(self)[:-1]}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def attributes(self) -> list[tuple[Attribute, NDArray[Any]]]:
        """The attributes that are known, with their values, in the order of `ATTRIBUTES`."""
        arrays = self.arrays
        return [(each, arrays[each.name]) for each in ATTRIBUTES if each.name in arrays]

    def select(self, which: NDArray[Any]) -> PointCloud:
        """Return the points of a boolean mask (N,) or of an index array, in that order."""
        # Indexing by position is several times faster than by mask.
        index = np.flatnonzero(which) if which.dtype == np.bool_ else which
        arrays: dict[str, Any] = {
            name: values.take(index, axis=0) for name, values in self.arrays.items()
        }
        return replace(self, **arrays)

    def only_measured(self) -> PointCloud:
        """Return the points that were measured; itself where nothing says that some were not."""
        return self if self.inferred is None else self.select(self.inferred == 0)


def join_clouds(clouds: Iterable[PointCloud], frame: Frame = "map") -> PointCloud:
    """Concatenate clouds of one frame; attributes that one with points lacks are dropped."""
    parts = [cloud.arrays for cloud in clouds if len(cloud)]
    if not parts:
        return PointCloud(np.zeros((0, 3), np.float32), frame=frame)
    shared = [name for name in parts[0] if all(name in part for part in parts)]
    joined: dict[str, Any] = {name: np.concatenate([p[name] for p in parts]) for name in shared}
    return PointCloud(**joined, frame=frame)


@dataclass(frozen=True, eq=False)
class Texture:
    """An image that colours a mesh."""

    image: UInt8  # (H, W, 3) RGB
    # (V, 2), right and down from its upper left corner to where each vertex is seen, from 0 to 1
    uv: Float32
    name: str = "texture.png"  # file name beside that of the mesh

    def __post_init__(self) -> None:
        freeze(self, "image", np.uint8, (None, None, 3))
        freeze(self, "uv", np.float32, (None, 2))


@dataclass(frozen=True, eq=False)
class TriangleMesh(Shape):
    """A surface: vertices float32 (V, 3), metres; faces int32 (F, 3), counter-clockwise outside.

    ``normals``, float32 (V, 3) unit vectors, ``rgb``, uint8 (V, 3), and ``texture`` may be None.
    """

    vertices: Float32
    faces: Int32
    normals: Float32 | None = None
    rgb: UInt8 | None = None
    texture: Texture | None = None

    def __post_init__(self) -> None:
        freeze(self, "vertices", np.float32, (None, 3))
        freeze(self, "faces", np.int32, (None, 3))
        freeze(self, "normals", np.float32, (len(self.vertices), 3))
        freeze(self, "rgb", np.uint8, (len(self.vertices), 3))

    def __repr__(self) -> str:
        vertices = counted(len(self.vertices), "vertex", "vertices")
        sizes = f"{counted(len(self.faces), 'face')}, {vertices}"
        return f"TriangleMesh({sizes}, {extent_text(self.vertices)})"


_CERTAIN: Final = 255


@dataclass(frozen=True)
class RayGrain:
    """Resolution of stored rays."""

    cell_m: float  # edge length of the cubes in which points are averaged
    unit_m: float  # quantisation step of the end points
    max_range_m: float  # points farther away are moved along their rays to just beyond this range


@dataclass(frozen=True, eq=False)
class RayCloud:
    """Rays of one frame from the camera to what it saw, in camera axes: evidence of free space."""

    places: NDArray[np.int16]  # int16 (N, 3), end points of the rays, multiples of ``unit_m``
    sigma_m: NDArray[np.float16]  # float16 (N,), standard deviation of the depth
    confidence: UInt8  # (N,), 255 = certain
    count: UInt8  # (N,), number of averaged points; 255 = 255 or more
    unit_m: float  # quantisation step of ``places``
    #: uint8, mean gradient of the image in squares, 255 = not known; empty = of none
    texture: UInt8 = field(default_factory=lambda: np.zeros((0, 0), np.uint8))

    def __post_init__(self) -> None:
        freeze(self, "texture", np.uint8, (None, None))
        freeze(self, "places", np.int16, (None, 3))
        freeze(self, "sigma_m", np.float16, (len(self.places),))
        freeze(self, "confidence", np.uint8, (len(self.places),))
        freeze(self, "count", np.uint8, (len(self.places),))

    def __repr__(self) -> str:
        return f"RayCloud({counted(len(self), 'ray')})"

    def __len__(self) -> int:
        return len(self.places)

    def select(self, which: NDArray[np.bool_]) -> RayCloud:
        """Return the rays of a mask (N,), with the texture of the image if there are any."""
        return RayCloud(
            self.places[which],
            self.sigma_m[which],
            self.confidence[which],
            self.count[which],
            self.unit_m,
            self.texture if which.any() else np.zeros((0, 0), np.uint8),
        )

    def cloud(self) -> PointCloud:
        return PointCloud(
            self.places * np.float32(self.unit_m),
            sigma_m=self.sigma_m.astype(np.float32),
            confidence=self.confidence / np.float32(_CERTAIN),
            count=self.count.astype(np.int32),
        )
