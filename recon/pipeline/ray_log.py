"""Keeps the rays of a drive while it is mapped, where there is a place for them."""

from __future__ import annotations

from pathlib import Path

from recon.formats.rays import RayWriter
from recon.mapping import OccupancySettings, ray_grain
from recon.structures import RayCloud


class RayLog:
    """Appends the rays of frames to a file.

    Args:
        path: The file; None = they are not kept.
        settings: Of the map that they are for.
    """

    def __init__(self, path: Path | None, settings: OccupancySettings) -> None:
        self._path = path if settings.keep_rays else None
        self._grain = ray_grain(settings)
        self._writer: RayWriter | None = None

    def add(self, rays: RayCloud) -> None:
        """Keep the rays of the next frame.

        Raises:
            OSError: The disk is full or cannot be written.
        """
        if self._path is None:
            return
        if self._writer is None:
            self._writer = RayWriter(self._path, self._grain)
        self._writer.append(rays)

    def state(self) -> int | None:
        """Bytes of the file, all on the disk; None = no file."""
        return None if self._writer is None else self._writer.sync()

    def restore(self, state: int | None) -> None:
        """Go on from a `state`; what the file holds beyond it is forgotten.

        Raises:
            FormatError: The file has been lost or cut.
        """
        if self._path is not None and state is not None:
            self._writer = RayWriter(self._path, self._grain, state)

    def close(self) -> None:
        """Nothing more comes."""
        if self._writer is not None:
            self._writer.close()
