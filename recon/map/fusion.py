"""One fused cloud of many: a voxel averages what all frames saw in it."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.core.errors import FormatError
from recon.core.geometry.se3 import apply, rotate
from recon.core.kernels import voxels
from recon.core.settings import Length, Settings
from recon.core.values import ATTRIBUTES, Attribute, PointCloud, RectifiedCamera
from recon.core.values.arrays import Bool, Float32, Float64, Int32, Int64, UInt8, array_in

_NOMINAL_ERROR_PX: Final = 0.3  # error of a good match, by which the range of fusion is found


class FusionSettings(Settings):
    """How clouds are fused."""

    voxel_m: float = Length(0.1, ge=1e-06, le=1000.0)
    """Edge of a voxel. Half of it takes about four times the memory."""
    min_count: int = Field(3, ge=1, le=1000)
    """Voxels seen by fewer frames are not exported, or by fewer than one less where they are
    precise. Lower it for sparse drives and small voxels (2 for half the usual edge), raise it where
    noise is left."""
    max_depth_error_m: float | None = Length(0.25, ge=1e-09, le=1000.0)
    """Points are fused up to the depth at which a matching error of 0.3 px makes this error, or to
    that of `doublings`; none = all. Raise it to map farther and less precisely."""
    doublings: int | None = Field(None, ge=0, le=8)
    """Beyond that depth, points go into voxels twice as large where they err twice as much, and so
    on, so often; 0 = none beyond. none = as the scene is: 0 on a road, 1 in one half as large, 2 in
    smaller ones."""
    remove_moving: bool = True
    """Leave points of things that moved out of the cloud and the mesh: what was there as a whole at
    one time and gone at another, by the rays of single frames (occupancy.keep_rays). They are
    written to map/removed.ply. What left before a plain wall, which no ray reaches, is taken out of
    occupancy and grid, too."""

    @property
    def largest_voxel_m(self) -> float:
        """Edge of a voxel where depth is least certain."""
        return self.voxel_m * 2.0 ** (self.doublings or 0)


def nominal_error_m(depth_m: float, camera: RectifiedCamera) -> float:
    """Return the error that 0.3 px make at a depth: ``Z²·error_px / (f·b)``."""
    return depth_m**2 * _NOMINAL_ERROR_PX / (camera.focal_px * camera.baseline_m)


def fusion_range_m(camera: RectifiedCamera, settings: FusionSettings) -> float:
    """Return the depth up to which points are fused."""
    if settings.max_depth_error_m is None:
        return math.inf
    most_m = settings.max_depth_error_m * 2.0 ** (settings.doublings or 0)
    return math.sqrt(most_m / nominal_error_m(1.0, camera))


def voxel_doublings(
    depth_m: NDArray[np.floating], camera: RectifiedCamera, settings: FusionSettings
) -> UInt8:
    """Return uint8 (N,), how often voxels are doubled for points at depths (N,)."""
    if not settings.doublings or settings.max_depth_error_m is None:
        return np.zeros(len(depth_m), np.uint8)
    times = (
        nominal_error_m(1.0, camera) / settings.max_depth_error_m * depth_m.astype(np.float64) ** 2
    )
    return np.ceil(np.log2(np.clip(times, 1.0, 2.0**settings.doublings))).astype(np.uint8)


KNOWABLE: Final = ("rgb", "normals", "sigma_m", "confidence")
"""What every map has room for, in the order of its sums; others only where clouds have them."""
_OF_NAME: Final = {each.name: each for each in ATTRIBUTES if each.fused is not None}
_MORE: Final = [name for name, each in _OF_NAME.items() if each.fused != "own"]
ALL: Final = (*KNOWABLE, *(name for name in _MORE if name not in KNOWABLE))
"""What a map may know of its points, beside how many frames saw each."""


def columns_in(known: Collection[str]) -> dict[Attribute, slice]:
    """Return where in the sums of a voxel those of attributes lie."""
    if unknown := [name for name in known if name not in ALL]:
        what = "points of the map have an attribute that this version does not know"
        raise FormatError(what, got=unknown[0], hint="update recon")
    found, begin = {}, 4  # behind the weight and the offset
    for each in (_OF_NAME[name] for name in ALL if name in known or name in KNOWABLE):
        if each.fused != "own":
            found[each] = slice(begin, begin + each.columns)
            begin += each.columns
    return found


def sums_in(known: Collection[str]) -> int:
    """Return how many sums of a voxel there are: of weight, offset and attributes."""
    return 4 + sum(each.columns for each in columns_in(known))


def row_bytes(known: Collection[str]) -> int:
    """Return the bytes of one voxel of a `FusedPart`."""
    return 16 + 4 * sums_in(known)


_PRECISE: Final = 0.8  # voxels known to this fraction of their edge need one frame less
_PLACED: Final = slice(0, 4)
_MOST: Final = 1e20
"""Larger than any sum of weights, or of values by weight; sums of much larger ones overflow."""
_LARGEST_M: Final = 1e3  # larger than any voxel
_FARTHEST_CELL: Final = voxels.KEY_LIMIT - (voxels.KEY_LIMIT >> 4)
"""Voxels that are moved by loops still have a key."""
_OFFSET: Final = slice(1, 4)
_PLACE_BITS: Final = 12
"""Of weights and offsets: the mean of a voxel of 0.1 m moves by some µm at most."""
_VALUE_BITS: Final = 8  # of colours, normals and the rest: half a level of 255, a tenth of a degree
_INFORMATION_BITS: Final = 16  # it decides which voxels are precise enough to be exported


@dataclass(frozen=True, eq=False)
class FusedPart:
    """Sums per voxel, one row each, in the order in which voxels were first seen."""

    # int64 (N,), packed cells in world axes (`recon.core.kernels.voxels`), each once
    keys: Int64
    # float32 (N, 4 + C): sum of weights; weighted sums of the offset from the voxel's centre and of
    # the values (`columns_in`)
    sums: Float32
    information: Float32  # (N,), sum over frames of the largest weight in each frame
    frames: Int32  # int32 (N,), number of frames that saw the voxel
    # Which of `ALL` all clouds had; empty where there was no cloud
    known: tuple[str, ...] = KNOWABLE

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def cells(self) -> Int32:
        """int32 (N, 3), indices of the voxels."""
        return voxels.unpack_keys(self.keys)

    def select(self, which: NDArray[Any]) -> FusedPart:
        """Return the rows of a boolean mask or of an index array, in that order."""
        keys, sums, information = self.keys[which], self.sums[which], self.information[which]
        return FusedPart(keys, sums, information, self.frames[which], self.known)

    def knowing(self, known: tuple[str, ...]) -> FusedPart:
        """Return the part with these attributes alone, all of which it has, unless it is empty."""
        return replace(self, sums=sums_of(self.sums, self.known, known), known=known)

    def rounded(self) -> FusedPart:
        """Return the sums to as many digits as they mean something, so that they compress."""
        sums = self.sums.copy()
        sums[:, _PLACED] = _rounded(sums[:, _PLACED], _PLACE_BITS)
        sums[:, _PLACED.stop :] = _rounded(sums[:, _PLACED.stop :], _VALUE_BITS)
        return replace(self, sums=sums, information=_rounded(self.information, _INFORMATION_BITS))

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> FusedPart:
        """Return the part that a tree (`tree_of`) is of."""
        keys, known = array_in(tree, "keys", np.int64, (None,)), tuple(tree["known"])
        sums = array_in(tree, "sums", np.float32, (len(keys), sums_in(known)))
        information = array_in(tree, "information", np.float32, (len(keys),))
        frames = array_in(tree, "frames", np.int32, (len(keys),))
        least = [each.min(initial=1) for each in (sums[:, 0], information, frames)]
        beside = np.abs(sums[:, _OFFSET]) > _LARGEST_M * sums[:, :1]
        far = np.abs(voxels.unpack_keys(keys)).max(initial=0) > _FARTHEST_CELL
        wrong = (
            keys.min(initial=0) < 0 or far or min(least) <= 0 or np.abs(sums).max(initial=0) > _MOST
        )
        if wrong or beside.any():
            raise FormatError("a submap of the map has an impossible voxel")
        return cls(keys, sums, information, frames, known)

    def moved(self, T_new_world: Float64, voxel_m: float) -> FusedPart:
        """Return the part after a rigid motion: sums of a voxel go to that of its moved mean point.

        Where several go to the same voxel, their sums add up; the number of frames and the
        information are the largest of theirs, since the frames are the same.
        """
        if not len(self):
            return self
        points = apply(T_new_world, self.points(voxel_m))
        cells = np.floor(points / voxel_m).astype(np.int64)
        sums = self.sums.copy()
        sums[:, _OFFSET] = self.sums[:, :1] * (points - (cells + 0.5) * voxel_m)
        for each, columns in columns_in(self.known).items():
            if each.fused == "direction":
                sums[:, columns] = rotate(T_new_world, sums[:, columns])
        # One row for each voxel, in the order of the first row of each.
        keys = voxels.pack_keys(cells)
        order = np.argsort(keys, kind="stable")
        begin = np.flatnonzero(np.diff(keys[order], prepend=-1))
        merged = FusedPart(
            keys[order][begin],
            np.add.reduceat(sums[order], begin, axis=0),
            np.maximum.reduceat(self.information[order], begin),
            np.maximum.reduceat(self.frames[order], begin),
            self.known,
        )
        return merged.select(np.argsort(order[begin], kind="stable"))

    def cloud(self, voxel_m: float, least: int) -> PointCloud:
        """Return one point per voxel that `enough` frames saw, frame ``world``, as first seen.

        ``sigma_m`` treats frames as independent, and the points of one frame in one voxel as one
        measurement. Voxels whose normals cancel are left out.
        """
        part = self.select(np.flatnonzero(self.enough(least, voxel_m)))
        for each, columns in columns_in(self.known).items():
            if each.fused == "direction" and each.name in self.known:
                # 1e-3: below, the direction is that of rounding errors.
                length = np.linalg.norm(part.sums[:, columns], axis=1)
                part = part.select(length > 1e-3 * part.sums[:, 0])
        weight = part.sums[:, :1]
        found: dict[str, Any] = {
            each.name: each.of_means(part.sums[:, columns] / weight)
            for each, columns in columns_in(self.known).items()
            if each.name in self.known
        }
        if "sigma_m" in self.known:
            found["sigma_m"] = part.information ** np.float32(-0.5)
        xyz = part.points(voxel_m).astype(np.float32)
        return PointCloud(
            xyz, weight=weight[:, 0].copy(), count=part.frames, frame="world", **found
        )

    def points(self, voxel_m: float) -> Float64:
        """Return float64 (N, 3), the mean point of each voxel, world axes."""
        return np.asarray((self.cells + 0.5) * voxel_m + self.sums[:, _OFFSET] / self.sums[:, :1])

    @property
    def frame_sigma_m(self) -> Float32:
        """float32 (N,), standard deviation of a point in one frame; 0 where it is not known."""
        if "sigma_m" not in self.known:
            return np.zeros(len(self), np.float32)
        variance = self.frames / np.maximum(self.information, np.float32(1e-9))
        return np.asarray(np.sqrt(variance), np.float32)

    def enough(self, least: int, voxel_m: float) -> Bool:
        """Return bool (N,): seen by ``least`` frames, precise ones by one less."""
        if "sigma_m" not in self.known:
            return np.asarray(self.frames >= least)
        precise = self.information >= np.float32((_PRECISE * voxel_m) ** -2)
        return np.asarray(self.frames >= np.where(precise, max(1, least - 1), least))


def sums_of(sums: Float32, known: tuple[str, ...], wanted: Collection[str]) -> Float32:
    """Return sums (N, 4 + C) with the columns of other attributes, all of them ``known``."""
    have, want = columns_in(known), columns_in(wanted)
    if have == want or not len(sums):
        return sums if have == want else np.zeros((0, sums_in(wanted)), np.float32)
    return np.concatenate([sums[:, :4], *(sums[:, have[each]] for each in want)], axis=1)


def join_fused(parts: Iterable[FusedPart]) -> FusedPart:
    """Add parts of different frames, as if all their frames had been fused into one map.

    Attributes that one of the parts does not know are unknown in the sum; empty parts do not count.
    """
    total, known = voxels.make_sums(1, sums_in(ALL) - 4), ALL
    for part in filter(len, parts):
        both = tuple(name for name in known if name in part.known)
        total = total._replace(sums=sums_of(total.sums, known, both))
        sums, known = sums_of(part.sums, part.known, both), both
        total = voxels.add_rows(total, part.keys, sums, part.information, part.frames)
    n = int(total.used[0])
    found = FusedPart(
        total.keys[:n], total.sums[:n], total.information[:n], total.frames[:n], known
    )
    return found if n else found.knowing(())


def _rounded(values: Float32, bits: int) -> Float32:
    """Return numbers with fewer bits behind the point of their mantissa; the rest is zero."""
    drop = 23 - bits
    half = np.int32(1 << (drop - 1))
    whole = np.ascontiguousarray(values).view(np.int32) + half
    return np.asarray((whole >> drop << drop).view(np.float32))
