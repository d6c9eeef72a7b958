"""The keyframes of a session, as records of a map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any, Final

import numpy as np

from recon.core.values.arrays import array_in
from recon.io.files import reading
from recon.map.store.links import loop_in
from recon.map.store.records import Store
from recon.map.store.values import value_in
from recon.places.detector import StoredKeyframe
from recon.places.keyframe import Keyframe

KEYFRAME: Final = "keyframe"
_MOST_BYTES: Final = 1 << 24
"""Hundreds of features, and every 64th disparity: of 100 megapixels 6 MB."""


class Keyframes:
    """Keyframes of one drive, by the number of their frame.

    Args:
        store: The records of the map.
        session: Number of the session.
    """

    def __init__(self, store: Store, session: int = 0) -> None:
        self._store = store
        self._session = session

    def put(self, stored: StoredKeyframe) -> None:
        """Keep a keyframe."""
        content = {
            "keyframe": asdict(stored.keyframe),
            "T_world_camera": stored.T_world_camera,
            "path_m": stored.path_m,
            "loops": [asdict(loop) for loop in stored.loops],
            "refused": list(stored.refused),
        }
        key = (self._session, stored.keyframe.frame)
        self._store.put(KEYFRAME, key, content, compress=True)

    def get(self, frame: int) -> StoredKeyframe:
        """Return the keyframe of a frame, read unless it was read lately."""
        key = (KEYFRAME, self._session, frame, "keyframe")
        return self._store.cache.get(key, lambda: self._read(frame))

    @property
    def frames(self) -> list[int]:
        """The numbers of the frames that are keyframes, in order."""
        return self._store.numbers(KEYFRAME, self._session)

    def __iter__(self) -> Iterator[StoredKeyframe]:
        """Return all keyframes, in the order of their frames."""
        return map(self._read, self.frames)

    def _read(self, frame: int) -> StoredKeyframe:
        with reading(self._store.name):
            content: dict[str, Any] = self._store.read(
                KEYFRAME, (self._session, frame), most_bytes=_MOST_BYTES
            )
            return StoredKeyframe(
                value_in(Keyframe, {**content["keyframe"], "frame": frame}),
                array_in(content, "T_world_camera", np.float64, (4, 4)),
                float(content["path_m"]),
                tuple(loop_in(loop) for loop in content["loops"]),
                tuple(content["refused"]),
            )
