"""What a product of a map is made from, and what comes of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from recon.core.errors import OutputError
from recon.core.summary import Figures
from recon.core.values.arrays import Float64
from recon.export.images import DriveImages, open_images
from recon.export.mesh.poisson import MeshSettings
from recon.map.map import Map
from recon.map.sessions.georeference import Georeference
from recon.map.sessions.placed import PlacedMap


@dataclass(frozen=True, eq=False)
class ExportContext:
    """A map with its drives in tiles, and how its products are wanted."""

    map: Map
    placed: PlacedMap
    mesh: MeshSettings  # settings of the mesh
    formats: Sequence[str] = ("ply",)  # formats of the mesh
    threads: int = 1
    # Where the map is in a survey, as products of surveys are written; None = in its own axes
    survey: Georeference | None = None
    images: Sequence[Path] = ()  # where drives are now, if not where the map says

    @cached_property
    def drives(self) -> list[DriveImages]:
        """The linked drives with their images, which all products share; perhaps `ReconError`."""
        return open_images(self.map, self.images)

    @property
    def T_survey_map(self) -> Float64:
        """How map axes become those of a survey (4, 4); without one they stay."""
        return np.eye(4) if self.survey is None else self.survey.T_survey_map

    @property
    def crs(self) -> str | None:
        """The coordinate system of the survey; None = not known."""
        return None if self.survey is None else self.survey.system


@dataclass(frozen=True)
class ProductFigures(Figures):
    """Base of what is counted and measured of a product."""

    @property
    def text(self) -> str:
        """The most important ones in a few words: what is counted, by the last word of its name."""
        counts = ((one.name, getattr(self, one.name)) for one in fields(self))
        known = [(name.rpartition("_")[2], n) for name, n in counts if isinstance(n, int) and n]
        return ", ".join(f"{n:,} {word}" for word, n in known)


@dataclass(frozen=True)
class PointFigures(ProductFigures):
    """A cloud."""

    points: int


@dataclass(frozen=True, eq=False)
class ExportResult:
    """What is left of a written product: its figures, warnings, what a report shows."""

    figures: ProductFigures
    warnings: Sequence[str] = ()
    value: Any = field(default=None, repr=False)


@dataclass(frozen=True)
class Product:
    """A kind of file, or of folder."""

    name: str  # of the file, or of the folder, in that of a run
    write: Callable[[ExportContext, Path], ExportResult]  # to a path with the suffix of the name
    others: tuple[str, ...] = ()  # other suffixes, of which each can be asked for
    parts: tuple[str, ...] = ()  # suffixes of the files beside it that belong to it
    needs_occupancy: bool = False  # whether it is made of what is free and occupied
    surveyed: bool = False  # whether it can be in the coordinates of a survey
    needs_images: bool = False  # whether it is made of the images of the drives, too

    @property
    def suffix(self) -> str:
        """That of the name; empty = it is a folder."""
        return "".join(Path(self.name).suffixes)

    def stem_and_suffix(self, path: Path) -> tuple[str, str]:
        """Return how the name of a file begins and ends; `OutputError` if it is of another kind."""
        for end in (self.suffix, *self.others):
            cut = len(path.name) - len(end)
            if cut > 0 and path.name[cut:].lower() == end:
                return path.name[:cut], path.name[cut:]
        expected = " or ".join((self.suffix, *self.others))
        raise OutputError("the product is another kind of file", where=path, expected=expected)
