"""A limit for the memory of a run: what is cut smaller to keep to it, and who watches it."""

from __future__ import annotations

import re
from typing import Final

from pydantic import Field

from recon.errors import MemoryLimitError, SettingsError
from recon.pipeline.machine import peak_memory_mb
from recon.settings import Settings

_UNITS_MB: Final = {"": 1, "M": 1, "MB": 1, "G": 1000, "GB": 1000}
_SIZE: Final = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]*)\s*")
#: What of a limit an open submap, and the cells of one tile, may take. Stores grow by doubling and
#: are copied when they are closed, so each costs some times as much for a moment; the larger
#: part of the limit is left to the libraries, the pictures and the matcher.
_SUBMAP_SHARE: Final = 1 / 40
_TILE_SHARE: Final = 1 / 24
_CACHED: Final = 6
_FEW_CACHED: Final = 2


class MemorySettings(Settings):
    """How much memory a run may take."""

    limit_mb: float | None = Field(
        None,
        gt=0.0,
        description="Largest resident memory of the process, in 10⁶ bytes; none = no limit. "
        "Submaps and tiles are made smaller to meet it, so results may differ by rounding.",
    )

    @property
    def submap_bytes(self) -> int | None:
        """Size at which a submap is closed; None = only where the path says so."""
        return None if self.limit_mb is None else int(1e6 * self.limit_mb * _SUBMAP_SHARE)

    @property
    def tile_bytes(self) -> int | None:
        """Most that the cells of a tile take before they are put together; None = any."""
        return None if self.limit_mb is None else int(1e6 * self.limit_mb * _TILE_SHARE)

    @property
    def cached_submaps(self) -> int:
        """How many submaps are kept after they were read."""
        return _CACHED if self.limit_mb is None else _FEW_CACHED

    def check(self, where: str) -> None:
        """Stop a run that takes more than it may.

        Raises:
            MemoryLimitError: The process took more at some time.
        """
        if self.limit_mb is not None and peak_memory_mb() > self.limit_mb:
            raise MemoryLimitError(
                "the memory limit cannot be kept",
                where=where,
                got=f"{peak_memory_mb():.0f} MB",
                expected=f"at most {self.limit_mb:g} MB",
                hint="give more with --memory-limit, or take smaller images, fewer disparities "
                "or a coarser map",
            )


def memory_overrides(limit: str | None) -> list[str]:
    """The setting for a size such as ``2G`` or ``1500M``; None = as it is.

    Raises:
        SettingsError: It is no size.
    """
    return [] if limit is None else [f"memory.limit_mb={parse_size_mb(limit):g}"]


def parse_size_mb(text: str) -> float:
    """A size in 10⁶ bytes; without a unit it is in those.

    Raises:
        SettingsError: It is no size.
    """
    found = _SIZE.fullmatch(text)
    unit = None if found is None else _UNITS_MB.get(found[2].upper())
    if found is None or unit is None or float(found[1]) == 0:
        raise SettingsError("cannot read this size", got=text, expected="such as 2G or 1500M")
    return float(found[1]) * unit
