"""`recon.Map`: a map file with what is done with it: merge, cut, ask what is where, find a pair."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from recon.core.errors import ShapeError
from recon.core.kernels.voxels import KEY_LIMIT, find_keys, pack_keys
from recon.core.values import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    RectifiedCamera,
    StereoCalibration,
    StereoPair,
)
from recon.core.values.arrays import Float32, Float64, Int8, Int64, freeze
from recon.map.esdf import DistanceField
from recon.map.ground.grid import drop_undecided
from recon.map.localize.localizer import Localizer, Located
from recon.map.sessions.copying import copy_sessions
from recon.map.sessions.joining import join_new
from recon.map.sessions.placed import check_rays, has_occupancy, place_map, settings_of
from recon.map.settings import DriveSettings
from recon.map.store.map_file import MapFile, known_places
from recon.map.store.session import Session
from recon.map.tiles import Tiles
from recon.odometry.protocol import OdometryFrame
from recon.stereo.frame import FrameReconstructor


class Map(MapFile):
    """One or several drives on disk, to be merged, cut or searched; `MapFile` has what is in it."""

    _cut: tuple[object, Tiles] | None = None
    _field: DistanceField | None = None

    def merge(self, other: Map) -> list[Session]:
        """Add the drives of another finished map, and place those that saw the same places.

        Returns the drives that are new here; those that could be placed are in `linked`. `commit`
        makes the change permanent; ``other`` stays as it is.

        Raises:
            FormatError: A map is damaged, or a drive is in both.
            OutputError: The map cannot be written.
        """
        new = copy_sessions(other, self)
        join_new(self, new)
        return [self.session(number) for number in new]

    def tiles(self, settings: DriveSettings | None = None) -> Tiles:
        """Return the linked drives in tiles: cloud, what moved, and occupancy from their rays.

        ``settings`` = None takes those of the first drive.

        Raises:
            FormatError: A drive kept no rays, or the map is damaged.
            SettingsError: The settings need finer or longer rays than were kept.
        """
        return place_map(self, settings or settings_of(self.first)).tiles

    def at(self, xyz: ArrayLike) -> MapPlaces:
        """Return what the map knows of places (3,) or (N, 3), map axes: is there anything?

        Whether each is occupied, free or unknown, the nearest point of the cloud, and which frames
        saw it. Map axes are metres, x forward, y left, z up; ``first.T_map_world`` leads to them
        from the world of trajectories. The first call cuts the map as `tiles` does, and may take
        as long as a product; the tiles are kept until drives or links change.

        Raises:
            ShapeError: They are no such numbers, or not finite.
            FormatError: The map is damaged, or has no drive.
        """
        return look_up(self._kept_tiles(), xyz)

    @overload
    def distance(self, xyz: ArrayLike) -> Float64: ...
    @overload
    def distance(self, xyz: ArrayLike, *, gradient: Literal[True]) -> tuple[Float64, Float64]: ...
    def distance(
        self, xyz: ArrayLike, *, gradient: bool = False
    ) -> Float64 | tuple[Float64, Float64]:
        """Return how far places (3,) or (N, 3), map axes, are from the nearest occupied voxel.

        float64 (N,), metres to its cube, negative in occupied voxels (to the nearest free one).
        NaN = unknown space, which may hide what is nearer. Distances end at 5 m, times the scale of
        the scene: so much means that or more. With ``gradient`` also theirs, float64 (N, 3): of
        length 1, away from the obstacle; 0 where distances end, NaN where unknown. The first call
        cuts the map, as that of `at` does.

        Raises:
            ShapeError: They are no such numbers, or not finite.
            FormatError: The map is damaged, has no drive, or kept no rays.
            MappingError: Nothing was observed.
        """
        places = _checked(xyz)
        if not has_occupancy(self):
            check_rays(self.first, settings_of(self.first))
        tiles = self._kept_tiles()
        if self._field is None or self._field.tiles is not tiles:
            self._field = DistanceField(tiles)
        found = self._field.at(places)
        return found if gradient else found[0]

    def _kept_tiles(self) -> Tiles:
        """Return the tiles of the drives as they are linked now."""
        state = [(session.number, len(session)) for session in self.linked], len(self.links)
        if self._cut is None or self._cut[0] != state:
            self._cut = state, self.tiles()
        return self._cut[1]

    def localize(
        self,
        pair: StereoPair,
        calibration: RectifiedCamera | StereoCalibration | None = None,
        config: DriveSettings | None = None,
    ) -> Located:
        """Find where a single pair was taken, without knowing anything else.

        Returns state ``tracking`` with the pose in the world of the map, or ``searching``. A drive
        is found more surely, and faster, by `recon.run_localize`. Without a calibration, the pair
        is rectified and of the cameras of the map.

        Raises:
            ReconError: The map has no keyframes or is damaged, or images and calibration do not
                fit together.
        """
        rig = calibration or self.first.camera
        reconstructor = FrameReconstructor(rig, config or DriveSettings())
        # Several views of the map must show the place, since no second frame confirms it.
        localizer = Localizer(known_places(self), frames=1)
        return localizer.add(OdometryFrame(*reconstructor.match(pair)))


@dataclass(frozen=True, eq=False)
class MapPlaces:
    """What a map knows of N places.

    Attributes:
        xyz: float64 (N, 3), the places, map axes.
        state: int8 (N,), FREE, OCCUPIED or UNKNOWN, as in an OctoMap of the map.
        nearest: float32 (N, 3), the nearest point of the fused cloud to each; NaN = it is empty.
        sightings: int64 (S, 4), by frame: number of a place, drive and frame, and 1 where the
            frame hit the voxel of the place, -1 where it looked through; None = a drive kept no
            rays, so nobody knows.
    """

    xyz: Float64
    state: Int8
    nearest: Float32
    sightings: Int64 | None

    def __post_init__(self) -> None:
        freeze(self, "xyz", np.float64, (None, 3))
        freeze(self, "state", np.int8, (len(self.xyz),))
        freeze(self, "nearest", np.float32, (len(self.xyz), 3))
        freeze(self, "sightings", np.int64, (None, 4))

    def __len__(self) -> int:
        return len(self.xyz)

    def __repr__(self) -> str:
        named = (("occupied", OCCUPIED), ("free", FREE), ("unknown", UNKNOWN))
        counts = ", ".join(f"{int((self.state == value).sum())} {name}" for name, value in named)
        return f"MapPlaces({counts})"

    @property
    def distance_m(self) -> Float64:
        """float64 (N,), from the nearest points; NaN = the cloud is empty."""
        return np.asarray(np.linalg.norm(self.xyz - self.nearest, axis=1))

    def seen_by(self, number: int) -> list[tuple[int, int]]:
        """Return drive and frame of all that saw a place: hit its voxel, or looked through."""
        rows = np.zeros((0, 4), np.int64) if self.sightings is None else self.sightings
        return [(drive, frame) for place, drive, frame, _ in rows.tolist() if place == number]


def look_up(tiles: Tiles, xyz: ArrayLike) -> MapPlaces:
    """Return what a map in tiles knows of places (3,) or (N, 3), map axes; or `ShapeError`."""
    places = _checked(xyz)
    cells = np.floor(places / tiles.resolution_m)
    known = np.flatnonzero((np.abs(cells) < KEY_LIMIT).all(axis=1))
    cells = cells[known].astype(np.int64)
    state = np.full(len(places), UNKNOWN, np.int8)
    states, homes = np.full(len(cells), UNKNOWN, np.int8), cells[:, :2] // tiles.edge_cells
    for x, y in np.unique(homes, axis=0).tolist():
        rows = np.flatnonzero((homes == (x, y)).all(axis=1))
        voxels = drop_undecided(tiles.voxels((x, y)))
        packed = pack_keys(voxels.keys)
        order = np.argsort(packed)
        place, there = find_keys(pack_keys(cells[rows]), packed[order])
        occupied = voxels.log_odds[order[place[there]]] > 0
        states[rows[there]] = np.where(occupied, OCCUPIED, FREE)
    state[known] = states
    seen = None if tiles.observations is None else [np.zeros((0, 4), np.int64)]
    if tiles.observations is not None and seen is not None and len(known):
        keys, home = np.unique(pack_keys(cells), return_inverse=True)
        for number, look in tiles.observations.by_frame(keys):
            rows = np.flatnonzero(look[home])
            frame = np.tile(tiles.observations.frames[number], (len(rows), 1))
            seen.append(np.column_stack([known[rows], frame, look[home[rows]]]))
    sightings = None if seen is None else np.concatenate(seen)
    return MapPlaces(places, state, _nearest(tiles, places), sightings)


def _checked(xyz: ArrayLike) -> Float64:
    expected = "finite numbers (3,) or (N, 3)"
    try:
        places = np.atleast_2d(np.asarray(xyz))
    except ValueError as error:  # rows of different lengths
        raise ShapeError("not places", got=error, expected=expected) from error
    if places.dtype.kind not in "fiu" or places.shape[1:] != (3,) or not np.isfinite(places).all():
        got = f"{places.dtype} {places.shape}"
        raise ShapeError("not places", got=got, expected=expected)
    return places.astype(np.float64)


def _nearest(tiles: Tiles, places: Float64) -> Float32:
    """Return the nearest points (N, 3); the nearest tiles come first, and others seldom matter."""
    nearest, distance_m = np.full(places.shape, np.nan), np.full(len(places), np.inf)
    gaps = []
    for tile in tiles:
        box = tiles.bounds(tile.key)
        aside = np.maximum(np.maximum(box.low - places[:, :2], places[:, :2] - box.high), 0.0)
        gaps.append((tile, np.hypot(*aside.T)))
    for tile, gap_m in sorted(gaps, key=lambda one: float(one[1].min(initial=np.inf))):
        rows = np.flatnonzero(gap_m < distance_m)
        if len(rows) and len(tile.cloud):
            to_m, point = cKDTree(tile.cloud.xyz).query(places[rows])
            closer = to_m < distance_m[rows]
            distance_m[rows[closer]] = to_m[closer]
            nearest[rows[closer]] = tile.cloud.xyz[point[closer]]
    return nearest.astype(np.float32)
