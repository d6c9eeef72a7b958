"""The keyframes of all drives of a map, in its world."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import overload

from recon.core.errors import MappingError
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.map.store.map_file import MapFile
from recon.places.detector import KnownPlaces, KnownView


def known_places(map_: MapFile) -> KnownPlaces:
    """Return all places of a map, to recognise them."""
    views = MapViews(map_)
    if not views:
        raise MappingError(
            "the map has no keyframes to be recognised by",
            where=map_.store.name,
            hint="map the drive again with this version",
        )
    return KnownPlaces(views)


class MapViews(Sequence[KnownView]):
    """What a map can recognise; each view is read when it is asked for.

    Args:
        map_: The map.
        sessions: Numbers of the drives to take; None = those that share the axes of the map, as
            far as they have a place in it.
    """

    def __init__(self, map_: MapFile, sessions: Collection[int] | None = None) -> None:
        self._map = map_
        self._keys: list[tuple[int, int]] = []
        self._poses: dict[int, Float64] = {}
        self._cameras: dict[int, RectifiedCamera] = {}
        taken = map_.linked if sessions is None else map(map_.session, sorted(sessions))
        placed = map_.placed if sessions is None else None
        for session in taken:
            frames = session.keyframes.frames
            if placed is not None:
                frames = [frame for frame in frames if placed[session.number][frame]]
            if frames:
                T_world_session = map_.T_world_session(session)
                self._poses[session.number] = T_world_session @ session.trajectory.T_world_camera
                self._cameras[session.number] = session.camera
                self._keys.extend((session.number, frame) for frame in frames)

    def __len__(self) -> int:
        return len(self._keys)

    @overload
    def __getitem__(self, number: int) -> KnownView: ...
    @overload
    def __getitem__(self, number: slice) -> list[KnownView]: ...
    def __getitem__(self, number: int | slice) -> KnownView | list[KnownView]:
        """Return a view."""
        if isinstance(number, slice):
            return [self[n] for n in range(*number.indices(len(self)))]
        session, frame = self._keys[number]
        stored = self._map.session(session).keyframes.get(frame)
        pose = self._poses[session][frame]
        return KnownView(stored.keyframe, self._cameras[session], pose, session)
