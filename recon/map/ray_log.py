"""Storing the rays of a drive while it is mapped."""

from __future__ import annotations

from pathlib import Path

from recon.core.values import RayCloud
from recon.io.rays import RayWriter
from recon.map import OccupancySettings, ray_grain


class RayLog:
    """Appends the rays of frames to a file.

    Args:
        path: The file; None = rays are not kept.
        settings: Settings of the occupancy map that the rays are for.
    """

    def __init__(self, path: Path | None, settings: OccupancySettings) -> None:
        self._path = path if settings.keep_rays else None
        self._grain = ray_grain(settings)
        self._writer: RayWriter | None = None

    def add(self, rays: RayCloud) -> None:
        """Append the rays of the next frame.

        Raises:
            OSError: The disk is full or not writable.
        """
        if self._path is None:
            return
        if self._writer is None:
            self._writer = RayWriter(self._path, self._grain)
        self._writer.append(rays)

    def state(self) -> int | None:
        """Size of the file in bytes, synced to disk; None = no file."""
        return None if self._writer is None else self._writer.sync()

    def restore(self, state: int | None) -> None:
        """Continue from a `state`; later content of the file is discarded.

        Raises:
            FormatError: The file is missing or truncated.
        """
        if self._path is not None and state is not None:
            self._writer = RayWriter(self._path, self._grain, state)

    def close(self) -> None:
        """Close the file after the last frame."""
        if self._writer is not None:
            self._writer.close()
