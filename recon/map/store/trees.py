"""Records of a map as JSON and bytes, and the values of a drive as such records."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from typing import Any, Final, TypeVar, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from recon.core.dates import DateFrom
from recon.core.errors import FormatError, ShapeError
from recon.core.geometry.se3 import FARTHEST_M, check_rigid
from recon.core.values import (
    CameraIntrinsics,
    RayCloud,
    RayGrain,
    RectifiedCamera,
    Rig,
    StereoCalibration,
    Trajectory,
    check_size,
)
from recon.core.values.arrays import Float64, array_in, frozen_array
from recon.look.fault import active
from recon.look.fit import FittedFault
from recon.look.rig import KnownRig
from recon.odometry.protocol import OdometryHealth
from recon.places.places import Loop
from recon.stereo.rectify.epipolar import as_raw

Bytes = bytes | bytearray | memoryview
_RAW: Final = "raw"
_ZLIB: Final = "zlib"
_ARRAY: Final = "array"
_TREE: Final = "tree"
_KINDS: Final = "biuf"
_NARROW: Final = 16  # arrays with at most this many columns are compressed column by column
_INFLATED_PER_CHARACTER: Final = 32
"""Bytes of packed arrays for each character of the JSON, which names each frame and link."""


def to_bytes(tree: Mapping[str, Any], *, compress: bool) -> tuple[str, list[Bytes]]:
    """Return a tree as JSON, and the bytes of its arrays, to be written one after the other.

    In the JSON, ``{"tree": …}`` is a mapping and ``{"array": …}`` an array: its dtype as numpy
    spells it, its shape, ``C`` or ``F`` for the axis that varies fastest (the last, the first),
    ``raw`` or ``zlib``, and where its bytes begin and end.

    Compressed, the bytes of equal significance lie together: first of column 0 all lowest bytes,
    then all second ones and so on, then of column 1 (arrays with more than two axes or 16 columns
    count as one column). That makes measurements smaller by a fifth.
    """
    content: list[Bytes] = []
    size = 0

    def plain(value: Any) -> Any:
        nonlocal size
        if isinstance(value, np.ndarray):
            head, packed = _pack(value, compress=compress)
            content.append(packed)
            size += len(packed)
            return {_ARRAY: [*head, size - len(packed), size]}
        if isinstance(value, Mapping):
            if not all(isinstance(name, str) for name in value):
                raise TypeError("the names in a tree are texts")
            return {_TREE: {name: plain(item) for name, item in value.items()}}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        return value

    return json.dumps(plain(tree)), content


def from_bytes(text: str, read: Callable[[int], bytearray], most: int) -> dict[str, Any]:
    """Return the tree of `to_bytes`, its tuples as lists; ``read`` gives the next bytes.

    Each array takes over its own bytes, so that a tree takes no more memory than its arrays.
    Compressed arrays may take ``most`` bytes together, beside what the length of the JSON explains.
    """
    position, left = 0, most + _INFLATED_PER_CHARACTER * len(text)

    def restored(value: Any) -> Any:
        nonlocal position, left
        if isinstance(value, list):
            return [restored(item) for item in value]
        if not isinstance(value, dict):
            return value
        if _ARRAY in value:
            name, shape, layout, codec, begin, end = value[_ARRAY]
            if begin != position:
                raise FormatError("the arrays of a record of the map are not in order")
            position = end
            dtype = np.dtype(name)
            if dtype.kind not in _KINDS or min(shape, default=0) < 0:
                raise FormatError("an array of the map has an impossible type or shape")
            left -= math.prod(shape) * dtype.itemsize if codec == _ZLIB else 0
            if left < 0:
                raise FormatError("a record of the map claims more than it can hold")
            array = _unpack(
                read(end - begin), dtype, shape[::-1] if layout == "F" else shape, codec
            )
            return array.T if layout == "F" else array
        return {name: restored(item) for name, item in value[_TREE].items()}

    tree = restored(json.loads(text))
    if not isinstance(tree, dict):
        raise FormatError("a record of the map is not valid")
    return tree


def _pack(array: NDArray[Any], *, compress: bool) -> tuple[list[Any], bytes | memoryview]:
    # Products of matrices round differently in another order of axes.
    layout = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
    little = array.astype(array.dtype.newbyteorder("<"), copy=False)
    if little.dtype.kind not in _KINDS:
        raise TypeError(f"an array of {array.dtype} cannot be stored")
    flat = np.ascontiguousarray(little.T if layout == "F" else little)
    content: bytes | memoryview = flat.reshape(-1).view(np.uint8).data
    codec = _RAW
    if compress and array.size:
        # Runs and single bytes: as small as with a search for repeats, in half the time.
        packer = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_RLE)
        columns = flat.reshape(-1, _columns(flat.shape))
        planes = columns.view(np.uint8).reshape(*columns.shape, flat.dtype.itemsize)
        packed = packer.compress(planes.transpose(1, 2, 0).tobytes()) + packer.flush()
        if len(packed) < len(content):
            content, codec = packed, _ZLIB
    return [little.dtype.str, list(array.shape), layout, codec], content


def _unpack(packed: bytearray, dtype: np.dtype[Any], shape: list[int], codec: str) -> NDArray[Any]:
    """Return the array of these bytes, which it takes over where they are not compressed."""
    nbytes = math.prod(shape) * dtype.itemsize
    content: bytes | bytearray = packed  # compiled kernels take only arrays that can be written
    if codec == _ZLIB:
        content = zlib.decompressobj().decompress(packed, nbytes + 1)
    if len(content) != nbytes:
        raise FormatError("an array of the map is truncated")
    numbers: NDArray[Any] = np.frombuffer(content, np.uint8)
    if codec == _ZLIB:
        planes = numbers.reshape(_columns(shape), dtype.itemsize, -1).transpose(2, 0, 1)
        numbers = np.array(planes, order="C").reshape(-1)
    return numbers.view(dtype).reshape(shape)


def _columns(shape: Sequence[int]) -> int:
    return shape[1] if len(shape) == 2 and 0 < shape[1] <= _NARROW else 1


Value = TypeVar("Value")


def value_in(kind: type[Value], tree: Mapping[str, Any]) -> Value:
    """Return a dataclass of a tree of its fields; each part is checked against its type."""
    return kind(**{name: _part(kind, name, part) for name, part in tree.items()})


def _part(kind: Any, name: str, part: Any) -> Any:
    adapter: TypeAdapter[Any] | None = _adapters(kind).get(name)
    if adapter is None:
        if not isinstance(part, np.ndarray):
            raise ShapeError(f"{kind.__name__}.{name} is not an array", got=part)
        return part
    try:
        return adapter.validate_python(part)
    except ValidationError as error:
        (first, *_), what = error.errors(), f"{kind.__name__}.{name} is wrong"
        raise ShapeError(what, got=part, expected=first["msg"]) from error


@lru_cache
def _adapters(kind: Any) -> dict[str, TypeAdapter[Any]]:
    hints = get_type_hints(kind)
    plain = (one.name for one in fields(kind) if get_origin(hints[one.name]) is not np.ndarray)
    return {name: TypeAdapter(hints[name]) for name in plain}


FRAMES: Final = "frames"
_SKEW: Final = 1e-3  # of poses that were written with few digits
_HEALTH: Final = tuple(f.name for f in fields(OdometryHealth))


def frames_record(
    poses: Sequence[Float64], times_s: Sequence[float], health: Sequence[OdometryHealth]
) -> dict[str, Any]:
    """Return consecutive frames as a tree of arrays and plain values."""
    return {
        "T_world_camera": np.stack(poses),
        "times_s": np.array(times_s),
        "health": {name: [getattr(one, name) for one in health] for name in _HEALTH},
    }


def frames_in(content: Mapping[str, Any]) -> Iterator[tuple[Float64, float, OdometryHealth]]:
    """Yield pose, time and health of each frame in what `frames_record` gave."""
    times_s = array_in(content, "times_s", np.float64, (None,))
    path, columns = path_of(content["T_world_camera"], times_s), content["health"]
    for number, (T, time_s) in enumerate(zip(path.T_world_camera, times_s.tolist(), strict=True)):
        values = {name: columns[name][number] for name in _HEALTH}
        yield T, time_s, value_in(OdometryHealth, values)


def path_of(poses: Float64, times_s: Float64) -> Trajectory:
    """Return a path of poses that were read, maybe from a file with few digits."""
    path = Trajectory(array_in({"poses": poses}, "poses", np.float64, (None, 4, 4)), times_s)
    R = path.T_world_camera[:, :3, :3]
    skew = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    far_m = np.abs(path.positions_m).max(axis=1)
    wrong = (skew > _SKEW) | (far_m > FARTHEST_M) | (np.linalg.det(R) <= 0)
    wrong |= (path.T_world_camera[:, 3] != (0, 0, 0, 1)).any(axis=1)
    if wrong.any():
        raise FormatError("the path of the map has an impossible pose", got=int(np.argmax(wrong)))
    return path


RAYS: Final = "rays"
RAY_BYTES: Final = 10  # of one ray in a record; a frame has at most one for each pixel


def rays_record(rays: RayCloud, grain: RayGrain) -> dict[str, Any]:
    """Return rays as a tree of arrays and plain values."""
    # Between neighbours in the image: small numbers, which compress, written as positive ones of
    # which every second stands for a step back (0, −1, 1, −2 become 0, 1, 2, 3).
    steps = np.diff(rays.places, axis=0, prepend=np.zeros((1, 3), np.int16))
    return {
        "steps": ((steps << 1) ^ (steps >> 15)).view(np.uint16),
        "sigma_m": rays.sigma_m,
        "confidence": rays.confidence,
        "count": rays.count,
        "texture": rays.texture,
        "grain": asdict(grain),
    }


def rays_in(content: Mapping[str, Any]) -> tuple[RayCloud, RayGrain]:
    """Return the rays in what `rays_record` gave."""
    grain = value_in(RayGrain, content["grain"])
    sizes_m = (grain.cell_m, grain.unit_m, grain.max_range_m)
    ordered = 0 < min(sizes_m) <= max(sizes_m) <= grain.max_range_m <= FARTHEST_M
    if not (ordered and np.isfinite(sizes_m).all()):
        raise FormatError("sizes of the rays are impossible", got=sizes_m)
    steps = frozen_array("steps", content["steps"], np.uint16, (None, 3))
    places = np.cumsum(((steps >> 1) ^ -(steps & 1)).view(np.int16), axis=0, dtype=np.int16)
    if array_in(content, "sigma_m", np.float16, (len(places),)).min(initial=0.0) < 0:
        raise FormatError("a ray of the map has a negative deviation")
    parts = {name: content[name] for name in ("sigma_m", "confidence", "count")}
    if "texture" in content:  # older maps have none
        parts["texture"] = array_in(content, "texture", np.uint8, (None, None))
    return value_in(RayCloud, {"places": places, **parts, "unit_m": grain.unit_m}), grain


RIG: Final = "rig"


def rig_record(given: Rig, calibration: Rig, fitted: FittedFault) -> dict[str, Any]:
    """Return what a drive showed of its rig as a tree of arrays and plain values."""
    parts = {"given": given, "calibration": calibration, "fitted": fitted}
    return {name: asdict(part) for name, part in parts.items()}


def rig_in(content: Mapping[str, Any], name: str) -> KnownRig | None:
    """Return the rig in what `rig_record` gave; None if another version fitted other parameters."""
    given, calibration = (_calibration_in(content[key]) for key in ("given", "calibration"))
    size = as_raw(given).left
    check_size(calibration, size.width_px, size.height_px, "calibration")
    shown = active(given)
    tree = content["fitted"]
    count = len(array_in(tree, "values", np.float64, (None,)))
    covariance = array_in(tree, "covariance", np.float64, (count, count))
    array_in(tree, "lengthening", np.float64, (count,))
    if count != len(shown):
        return None
    if np.linalg.eigvalsh(covariance[np.ix_(shown, shown)])[0] <= 0.0:
        raise FormatError("a rig of the map has an impossible covariance")
    return KnownRig(given, calibration, value_in(FittedFault, tree), name)


def _calibration_in(tree: Mapping[str, Any]) -> Rig:
    if "T_right_left" not in tree:
        return value_in(RectifiedCamera, tree)
    left, right = (value_in(CameraIntrinsics, tree[side]) for side in ("left", "right"))
    return StereoCalibration(left, right, tree["T_right_left"])


FORGOTTEN: Final = "forgotten"


@dataclass(frozen=True)
class Forgotten:
    """A drive that was in a map, and left it."""

    number: int
    name: str
    date: str  # when it began, as `recon.core.dates.Date` has it
    date_from: DateFrom
    frames: int
    length_m: float
    forgotten: str  # when it left


LINKS: Final = "links"


def loop_in(tree: Mapping[str, Any]) -> Loop:
    """Return a loop of a tree of its fields."""
    loop = value_in(Loop, tree)
    check_rigid("T_first_last", loop.T_first_last)
    if not np.isfinite(loop.information).all() or np.linalg.eigvalsh(loop.information)[0] < 0:
        raise FormatError("a loop of the map has an impossible information")
    return loop


@dataclass(frozen=True, eq=False)
class Link:
    """A place that two drives saw.

    ``loop.first`` is a frame of the first of ``sessions``, ``loop.last`` one of the second;
    ``kept`` is whether the pose graph believes it.
    """

    sessions: tuple[int, int]
    loop: Loop
    kept: bool = True

    def to_tree(self) -> dict[str, Any]:
        return {"sessions": self.sessions, "loop": asdict(self.loop), "kept": self.kept}

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> Link:
        one, other = tree["sessions"]
        if not (isinstance(one, int) and isinstance(other, int) and one != other):
            raise FormatError("a link of the map is not between two drives", got=tree["sessions"])
        return cls((one, other), loop_in(tree["loop"]), bool(tree["kept"]))
