"""Values as records of a map, checked where they are read: frames, rays, loops and links."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError
from recon.core.geometry.se3 import check_rigid
from recon.core.values import RayCloud, RayGrain, Trajectory
from recon.core.values.arrays import Float64, array_in, frozen_array
from recon.map.store.trees import value_in
from recon.odometry.protocol import OdometryHealth
from recon.places.loop import Loop

FRAMES: Final = "frames"
FARTHEST_M: Final = 1e5  # from the start: farther than any drive, or ray
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
        # Older versions measured more.
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
    return {
        # Of neighbours in the image: small numbers, which compress.
        "steps": _zigzag(np.diff(rays.places, axis=0, prepend=np.zeros((1, 3), np.int16))),
        "sigma_m": rays.sigma_m,
        "confidence": rays.confidence,
        "count": rays.count,
        "grain": asdict(grain),
    }


def rays_in(content: Mapping[str, Any]) -> tuple[RayCloud, RayGrain]:
    """Return the rays in what `rays_record` gave."""
    grain = _checked(value_in(RayGrain, content["grain"]))
    steps = frozen_array("steps", content["steps"], np.uint16, (None, 3))
    places = np.cumsum(_unzigzag(steps), axis=0, dtype=np.int16)
    if array_in(content, "sigma_m", np.float16, (len(places),)).min(initial=0.0) < 0:
        raise FormatError("a ray of the map has a negative deviation")
    parts = {name: content[name] for name in ("sigma_m", "confidence", "count")}
    return value_in(RayCloud, {"places": places, **parts, "unit_m": grain.unit_m}), grain


def _checked(grain: RayGrain) -> RayGrain:
    sizes_m = (grain.cell_m, grain.unit_m, grain.max_range_m)
    ordered = 0 < min(sizes_m) <= max(sizes_m) <= grain.max_range_m <= FARTHEST_M
    if not (ordered and np.isfinite(sizes_m).all()):
        raise FormatError("sizes of the rays are impossible", got=sizes_m)
    return grain


def _zigzag(steps: NDArray[np.int16]) -> NDArray[np.uint16]:
    """Return steps of either sign as small positive numbers: 0, −1, 1, −2 become 0, 1, 2, 3."""
    return ((steps << 1) ^ (steps >> 15)).view(np.uint16)


def _unzigzag(codes: NDArray[np.uint16]) -> NDArray[np.int16]:
    return ((codes >> 1) ^ -(codes & 1)).view(np.int16)


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

    def between(self, one: int, other: int) -> Link:
        """Return the link with other numbers of its drives."""
        return replace(self, sessions=(one, other))

    def to_tree(self) -> dict[str, Any]:
        """Return all of it as a tree of arrays and plain values."""
        return {"sessions": self.sessions, "loop": asdict(self.loop), "kept": self.kept}

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> Link:
        """Return what `to_tree` gave."""
        one, other = tree["sessions"]
        if not (isinstance(one, int) and isinstance(other, int) and one != other):
            raise FormatError("a link of the map is not between two drives", got=tree["sessions"])
        return cls((one, other), loop_in(tree["loop"]), bool(tree["kept"]))
