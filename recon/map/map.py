"""`recon.Map`: a map file with what is done with it: merge, cut, ask, find a pair."""

from __future__ import annotations

from numpy.typing import ArrayLike

from recon.core.values import RectifiedCamera, StereoCalibration, StereoPair
from recon.map.localize.localizer import Located, localize_pair
from recon.map.query import MapPlaces, look_up
from recon.map.sessions.copying import copy_sessions
from recon.map.sessions.joining import join_new
from recon.map.sessions.placed import place_map, settings_of
from recon.map.settings import DriveSettings
from recon.map.store.map_file import MapFile
from recon.map.store.session import Session
from recon.map.tiles import Tiles


class Map(MapFile):
    """One or several drives on disk: open a map with `open`, then merge, cut or search it.

    Begin one with `create` or `temporary`; `MapFile` has what is in it.
    """

    _cut: tuple[object, Tiles] | None = None

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
        state = [(session.number, len(session)) for session in self.linked], len(self.links)
        if self._cut is None or self._cut[0] != state:
            self._cut = state, self.tiles()
        return look_up(self._cut[1], xyz)

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
        return localize_pair(self, pair, calibration or self.first.camera, config)
