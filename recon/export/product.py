"""What a product of a map is made from, and what comes of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from recon.export.mesh.poisson import MeshSettings
from recon.map.sessions.measured import Survey
from recon.map.sessions.placed import PlacedMap
from recon.map.verbs import Map
from recon.run.run import Run


@dataclass(frozen=True, eq=False)
class Order:
    """A map, and how its products are wanted.

    Attributes:
        map: The map.
        placed: Its drives, cut into tiles.
        run: The run, whose folder they go to.
        mesh: Settings of the mesh.
        formats: Formats of the mesh.
        survey: In whose coordinates LAS and LAZ are written; None = in those of the map.
    """

    map: Map
    placed: PlacedMap
    run: Run
    mesh: MeshSettings
    formats: Sequence[str] = ("ply",)
    survey: Survey | None = None


@dataclass(frozen=True, eq=False)
class Made:
    """What is left in memory of a product whose files are written.

    Attributes:
        figures: Its figures for ``summary.json``.
        warnings: What a user of it should know.
        value: What a report shows of it, if anything.
    """

    figures: dict[str, Any]
    warnings: Sequence[str] = ()
    value: Any = field(default=None, repr=False)


@dataclass(frozen=True)
class Product:
    """A kind of file, or of files, that are made from a map.

    Attributes:
        write: Writes them.
        needs_occupancy: Whether they are made of what is free and occupied.
    """

    write: Callable[[Order], Made]
    needs_occupancy: bool = False
