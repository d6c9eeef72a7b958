"""A session of a map: what one drive put into it, with its submaps and keyframes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np

from recon.core.dates import Date, DateFrom, date_of_stamp
from recon.core.errors import FormatError
from recon.core.geometry.se3 import check_rigid
from recon.core.text import counted
from recon.core.values import RayCloud, RayGrain, RectifiedCamera, Trajectory
from recon.core.values.arrays import Bool, Float64, array_in, tree_of
from recon.io.files import reading
from recon.look.rig import KnownRig, RefinedRig
from recon.map.builders import Submap
from recon.map.fusion import KNOWABLE, row_bytes
from recon.map.ground.level import Level
from recon.map.store.records import Store
from recon.map.store.trees import (
    FRAMES,
    RAY_BYTES,
    RAYS,
    RIG,
    frames_in,
    frames_record,
    loop_in,
    path_of,
    rays_in,
    rays_record,
    rig_in,
    rig_record,
    value_in,
)
from recon.odometry.health import trusted_poses
from recon.odometry.protocol import OdometryHealth
from recon.places.closure import Closure
from recon.places.detector import StoredKeyframe
from recon.places.keyframe import Keyframe
from recon.places.places import Loop
from recon.places.pose_graph import NO_FIXES, Fixes
from recon.sources.source import Mount

SESSION: Final = "session"
AXES: Final = "axes"
IMAGES: Final = "images"  # path and kind of the source, and its `mark_of`
LOOPS: Final = "loops"
OPTIMISED_POSES: Final = "T_world_camera"
"""The path of a drive after loops, links and measured positions; None = that of odometry."""
POSES_BEFORE_LINKS: Final = "T_alone_camera"  # the same before links to other drives optimised them
NO_LOOPS: Final[Mapping[str, Any]] = {"closed": [], "refused": [], OPTIMISED_POSES: None}
"""What a map keeps of a drive without loops, if it keeps anything else with them."""
THINNED: Final = "thinned"
_STATE: Final = "state"


@dataclass(frozen=True)
class Thinned:
    """What is left of a drive of which newer ones saw a part again: rays and keyframes.

    ``empty`` are the frames of which no ray is left.
    """

    rays: int
    rays_before: int  # when the drive was mapped
    keyframes: int
    keyframes_before: int
    empty: tuple[int, ...] = ()

    @property
    def rays_ratio(self) -> float:
        return self.rays / self.rays_before if self.rays_before else 1.0

    @property
    def keyframes_ratio(self) -> float:
        return self.keyframes / self.keyframes_before if self.keyframes_before else 1.0


@dataclass(frozen=True)
class SessionInfo:
    """What a session is a drive of.

    ``config`` are the settings of the drive as plain values, ``versions`` those of recon and its
    libraries, ``start`` what the run was started with; in a finished map, where the images are.
    ``date`` is that of its first image, in UTC ("" = not known), by what ``date_from`` says.
    """

    source: str = ""
    description: str = ""
    frames: int = 0
    config: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    start: Mapping[str, Any] = field(default_factory=dict)
    date: str = ""
    date_from: DateFrom = ""


class Session:
    """One drive in a map; the next commit of the map keeps what is added.

    ``mount`` is where the rectified left camera is on its robot, which is kept with the axes; None
    = nothing says so. ``level`` is by what its axes are level.
    """

    def __init__(self, store: Store, number: int) -> None:
        self._store = store
        self.number = number
        self._poses: list[Float64] = []
        self._times_s: list[float] = []
        self._health: list[OdometryHealth] = []
        with reading(store.name):
            self.info = value_in(SessionInfo, store.read(SESSION, number))
            for first in store.numbers(FRAMES, number):
                if first != len(self):
                    got = f"{len(self)} to {first}"
                    raise FormatError("frames of the drive are missing", got=got)
                for T, time_s, health in frames_in(store.read(FRAMES, (number, first))):
                    self.add_frame(T, time_s, health)
            self._flushed = len(self)
            axes = store.find(AXES, number)
            self.mount = value_in(Mount, axes["mount"]) if "mount" in axes else None
            if self.mount is not None:
                check_rigid("T_base_camera", self.mount.T_base_camera)
            self.level = value_in(Level, axes.get("level", {}))
            if sorted(self._times_s) != self._times_s:
                raise FormatError("frames of the drive are not in order")
            for name in (OPTIMISED_POSES, POSES_BEFORE_LINKS):
                if (poses := self.loops.get(name)) is not None:
                    path_of(poses, np.array(self._times_s))
            for loop in self.closed:
                if not 0 <= loop.first < loop.last < len(self):
                    raise FormatError("a loop of the map is not between two frames", got=f"{loop}")
        self.submaps = Submaps(store, number)
        if self.submaps.frames > len(self):
            raise FormatError("the map has submaps of frames without a pose", where=store.name)
        self.keyframes = Keyframes(store, number)
        if max(self.keyframes.frames, default=-1) >= len(self):
            raise FormatError("the map has keyframes of frames without a pose", where=store.name)

    @staticmethod
    def begin(store: Store, number: int, info: SessionInfo) -> Session:
        store.put(SESSION, number, asdict(info))
        return Session(store, number)

    def __len__(self) -> int:
        return len(self._poses)

    def __repr__(self) -> str:
        return f"Session({self.info.source!r}, {len(self)} of {counted(self.info.frames, 'frame')})"

    @property
    def where(self) -> str:
        return self._store.name

    @property
    def scale(self) -> float:
        """Size of its scene against a road, to which lengths that were not set are made."""
        with reading(self.where):
            return float(self.info.config.get("scene", {}).get("scale") or 1.0)

    @property
    def date(self) -> Date:
        """When the drive began; of a map that does not say so, by its stamps."""
        if self.info.date or not self._times_s:
            return Date(self.info.date, self.info.date_from)
        return date_of_stamp(self._times_s[0])

    @property
    def thinned(self) -> Thinned | None:
        """What newer drives left of this one; None = all."""
        if not self._store.has(THINNED, self.number):
            return None
        with reading(self._store.name):
            return value_in(Thinned, self._store.get(THINNED, self.number))

    @property
    def with_rays(self) -> list[int]:
        """The frames of which rays may be left."""
        empty = () if self.thinned is None else self.thinned.empty
        return [frame for frame in self._store.numbers(RAYS, self.number) if frame not in empty]

    def set_thinned(self, thinned: Thinned) -> None:
        self._store.put(THINNED, self.number, asdict(thinned))

    @property
    def odometry(self) -> Trajectory:
        if not self._poses:
            raise FormatError("the session has no frame", where=self._store.name)
        return Trajectory(np.stack(self._poses), np.array(self._times_s))

    @property
    def trajectory(self) -> Trajectory:
        """The path after loop closure; that of odometry if no loop was closed."""
        closed = self.loops.get(OPTIMISED_POSES)
        return self.odometry if closed is None else Trajectory(closed, np.array(self._times_s))

    @property
    def health(self) -> tuple[OdometryHealth, ...]:
        """How far each pose can be trusted."""
        return tuple(self._health)

    @property
    def trusted(self) -> Bool:
        """bool (N,), which poses are to be trusted."""
        return trusted_poses(self._health)

    @property
    def T_map_world(self) -> Float64:
        """float64 (4, 4), from the world of the session to map axes; known after one frame."""
        with reading(self._store.name):
            axes = self._store.get(AXES, self.number)
            T: Float64 = array_in(axes, "T_map_world", np.float64, (4, 4)).copy()
            check_rigid("T_map_world", T)
        return T

    @property
    def camera(self) -> RectifiedCamera:
        """The rectified camera; known after the first frame."""
        with reading(self._store.name):
            return value_in(RectifiedCamera, self._store.get(AXES, self.number)["camera"])

    @property
    def loops(self) -> dict[str, Any]:
        """Result of loop closure: ``closed`` and ``refused`` loops, ``T_world_camera`` after it."""
        return self._store.find(LOOPS, self.number)

    @property
    def closed(self) -> tuple[Loop, ...]:
        """The loops that were closed."""
        return tuple(map(loop_in, self.loops.get("closed", ())))

    def corrections(self) -> Float64 | None:
        """Return float64 (S, 4, 4), by what loops move each submap; None = nothing moves."""
        with reading(self._store.name):
            closure, odometry = Closure(self.trajectory, (), ()), self.odometry
            if self.loops.get(OPTIMISED_POSES) is None:
                return None
            entries = self.submaps.entries
            return np.stack([closure.correction(odometry, one.middle) for one in entries])

    @property
    def ray_frames(self) -> int:
        return len(self._store.numbers(RAYS, self.number))

    def set_axes(self, T_map_world: Float64, camera: RectifiedCamera) -> None:
        content = {"T_map_world": T_map_world, "camera": asdict(camera)}
        if self.mount is not None:
            content["mount"] = asdict(self.mount)
        self._store.put(AXES, self.number, content | {"level": asdict(self.level)})

    @property
    def rig(self) -> KnownRig | None:
        """What the drive showed of its rig; None if nothing is known."""
        if not self._store.has(RIG, self.number):
            return None
        with reading(self._store.name):
            name = f"session {self.number} ({self.info.source})"
            return rig_in(self._store.read(RIG, self.number), name)

    def set_rig(self, rig: RefinedRig) -> None:
        """Keep what the drive showed of its rig, for later drives, if it showed anything."""
        if rig.fitted is not None:
            content = rig_record(rig.given, rig.calibration, rig.fitted)
            self._store.put(RIG, self.number, content)

    def add_frame(self, T_world_camera: Float64, time_s: float, health: OdometryHealth) -> None:
        self._poses.append(T_world_camera)
        self._times_s.append(time_s)
        self._health.append(health)

    def add_rays(self, frame: int, rays: RayCloud, grain: RayGrain) -> None:
        self._store.put(RAYS, (self.number, frame), rays_record(rays, grain), compress=True)

    def rays(self, frame: int) -> tuple[RayCloud, RayGrain]:
        with reading(self._store.name):
            camera = self.camera
            most_bytes = RAY_BYTES * camera.width_px * camera.height_px
            return rays_in(self._store.read(RAYS, (self.number, frame), most_bytes=most_bytes))

    def same_rays(self, frame: int, other: Session, other_frame: int) -> bool:
        """Return whether this drive and another of the map kept the same rays, and any at all."""
        keys = (self.number, frame), (other.number, other_frame)
        return self._store.alike(RAYS, *keys) and len(self.rays(frame)[0].sigma_m) > 0

    def set_loops(self, content: Mapping[str, Any]) -> None:
        self._store.put(LOOPS, self.number, content)

    @property
    def fixes(self) -> Fixes:
        """Positions that were measured during the drive; usually none."""
        with reading(self._store.name):
            found = self.loops.get("fixes")
            fixes = NO_FIXES if found is None else value_in(Fixes, found)
        if not np.isin(fixes.frames, np.arange(len(self))).all():
            what = "the map has measured positions of frames without a pose"
            raise FormatError(what, where=self._store.name)
        return fixes

    def set_fixes(self, fixes: Fixes) -> None:
        """Keep positions that were measured during the drive, in place of earlier ones."""
        self.set_loops({**NO_LOOPS, **self.loops, "fixes": asdict(fixes)})

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Keep what the rest of the drive depends on, beside all that was added."""
        self._store.put(_STATE, self.number, state)

    def state(self) -> dict[str, Any] | None:
        """Return the state of an unfinished drive, to go on from; None = nothing is known."""
        if not self._store.has(_STATE, self.number):
            return None
        return self._store.read(_STATE, self.number)

    def flush(self) -> None:
        """Write the frames since the last time, so that a commit keeps them."""
        first, self._flushed = self._flushed, len(self)
        if first == len(self):
            return
        content = frames_record(self._poses[first:], self._times_s[first:], self._health[first:])
        self._store.put(FRAMES, (self.number, first), content, compress=True)


SUBMAP: Final = "submap"
ENTRY: Final = "submap_entry"
_CELL_BYTES: Final = 54  # most of one cell: its values, its surface point, and a block of its own


@dataclass(frozen=True)
class SubmapEntry:
    """What is known about a closed submap without reading it."""

    index: int
    first_frame: int
    frames: int
    voxels: int
    cells: int
    more: tuple[str, ...] = ()  # attributes of its points beside `KNOWABLE`

    @property
    def nbytes(self) -> int:
        """Most bytes that its arrays take."""
        return row_bytes(self.more) * self.voxels + _CELL_BYTES * self.cells

    @property
    def middle(self) -> int:
        """Index of the frame in its middle, whose correction the submap gets."""
        return self.first_frame + self.frames // 2


class Submaps:
    """Closed submaps of one drive, in order; each is read when it is asked for."""

    def __init__(self, store: Store, session: int = 0) -> None:
        self._session = session
        self.store = store
        with reading(store.name):
            found = store.numbers(ENTRY, session)
            self.entries = [value_in(SubmapEntry, store.read(ENTRY, (session, n))) for n in found]
            frames = 0
            for index, entry in enumerate(self.entries):
                if (entry.index, entry.first_frame) != (index, frames) or entry.frames < 1:
                    raise FormatError("submaps of the drive are missing", got=f"{entry}")
                frames += entry.frames

    def __len__(self) -> int:
        return len(self.entries)

    @property
    def frames(self) -> int:
        return sum(entry.frames for entry in self.entries)

    def add(self, submap: Submap, *, compress: bool = False) -> None:
        entry = _entry_of(submap)
        key = (self._session, submap.index)
        self.store.put(SUBMAP, key, tree_of(submap), compress=compress)
        content = asdict(entry).items()
        self.store.put(ENTRY, key, {name: value for name, value in content if value != ()})
        self.entries[submap.index : submap.index + 1] = [entry]

    def __getitem__(self, index: int) -> Submap:
        """Return a submap, read from the map: it is large, and used once."""
        with reading(self.store.name):
            most_bytes = self.entries[index].nbytes
            record = self.store.read(SUBMAP, (self._session, index), most_bytes=most_bytes)
            submap = Submap.from_tree(record)
            if _entry_of(submap) != self.entries[index]:
                raise FormatError("a submap of the map is another one", got=f"submap {index}")
            return submap

    def __iter__(self) -> Iterator[Submap]:
        return map(self.__getitem__, range(len(self)))


def _entry_of(submap: Submap) -> SubmapEntry:
    fused, cells = len(submap.fused), len(submap.occupancy)
    more = tuple(name for name in submap.fused.known if name not in KNOWABLE)
    return SubmapEntry(submap.index, submap.first_frame, submap.frames, fused, cells, more)


KEYFRAME: Final = "view"  # "keyframe" was of features that are compared no more
_MOST_BYTES: Final = 1 << 24
"""Hundreds of features, and every 64th disparity: of 100 megapixels 6 MB."""


class Keyframes:
    """Keyframes of one drive, by the number of their frame."""

    def __init__(self, store: Store, session: int = 0) -> None:
        self._store = store
        self._session = session

    def drop(self, frame: int) -> None:
        self._store.delete(KEYFRAME, (self._session, frame))
        self._store.cache.drop((KEYFRAME, self._session, frame, "keyframe"))

    def put(self, stored: StoredKeyframe) -> None:
        content = {
            "keyframe": asdict(stored.keyframe),
            "T_world_camera": stored.T_world_camera,
            "path_m": stored.path_m,
            "stretch": stored.segment,  # the name that it has in the format
            "loops": [asdict(loop) for loop in stored.loops],
            "refused": list(stored.refused),
        }
        self._store.put(KEYFRAME, (self._session, stored.keyframe.frame), content, compress=True)

    def get(self, frame: int) -> StoredKeyframe:
        key = (KEYFRAME, self._session, frame, "keyframe")
        return self._store.cache.get(key, lambda: self._read(frame))

    @property
    def frames(self) -> list[int]:
        return self._store.numbers(KEYFRAME, self._session)

    def __iter__(self) -> Iterator[StoredKeyframe]:
        return map(self._read, self.frames)

    def _read(self, frame: int) -> StoredKeyframe:
        with reading(self._store.name):
            key = (self._session, frame)
            content = self._store.read(KEYFRAME, key, most_bytes=_MOST_BYTES)
            return StoredKeyframe(
                value_in(Keyframe, {**content["keyframe"], "frame": frame}),
                array_in(content, "T_world_camera", np.float64, (4, 4)),
                float(content["path_m"]),
                int(np.int64(content["stretch"])),
                tuple(loop_in(loop) for loop in content["loops"]),
                tuple(content["refused"]),
            )
