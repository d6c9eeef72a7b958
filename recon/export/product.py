"""What a product of a map is made from, the images of its drives too, and what comes of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import OutputError, ReconError, SourceError
from recon.core.progress import tracked
from recon.core.summary import Figures
from recon.core.values import Recorded, Rig, StereoPair
from recon.core.values.arrays import Bool, Float64, UInt8
from recon.export.mesh.poisson import MeshSettings
from recon.io.files import reading, resolved
from recon.map.map import Map
from recon.map.sessions.georeference import Georeference
from recon.map.sessions.placed import PlacedMap, settings_of
from recon.map.store.map_file import MapFile
from recon.map.store.session import IMAGES, Session
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from recon.sources.source import StereoSource, mark_of
from recon.sources.synthetic import SyntheticSource
from recon.stereo.rectify.rectifier import Rectifier, turns_of
from recon.street.settings import StreetSettings


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
    gsd_m: float | None = None  # edge of a cell of the orthophoto; None = as a pixel on the ground

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


_KEPT_BYTES: Final = 1 << 28  # of a drive's rectified images that stay in memory


@dataclass(frozen=True, eq=False)
class DriveImages:
    """A linked drive of a map, and its images."""

    session: Session
    placed: Bool  # (N,), which frames have a place in the map
    prefix: str  # of names, which tells drives apart where there are several
    source: StereoSource
    rig: Rig  # with which it was mapped
    kept: dict[int, tuple[UInt8, ...]] = field(default_factory=dict, init=False)  # see `views`

    @cached_property
    def T_map_camera(self) -> Float64:
        """float64 (N, 4, 4), poses of the left camera in map axes."""
        return np.asarray(self.session.T_map_world @ self.session.trajectory.T_world_camera)

    @cached_property
    def rectifier(self) -> Rectifier:
        """What rectifies the images as they were when they were mapped."""
        return Rectifier(self.rig, settings_of(self.session).rectification)

    def rectified(self, pair: Recorded) -> tuple[UInt8, ...]:
        """Return what images there are of a frame, rectified, the left one first."""
        return self.rectifier.warp(pair) if isinstance(pair, StereoPair) else (pair.views[0][1],)

    def file(self, side: str, frame: int) -> str:
        return f"{self.prefix}{side}_{frame:06d}.png"

    def views(self) -> Iterator[tuple[int, tuple[UInt8, ...]]]:
        """Yield number and rectified images of the frames that have a place, the left one first.

        Those of the first frames stay in memory, as many as fit: whoever comes next need not read
        and rectify them again.
        """
        if self.kept:
            yield from tracked([*self.kept.items()], "images")
        room = _KEPT_BYTES - sum(one.nbytes for images in self.kept.values() for one in images)
        for frame, pair in self.pairs(max(self.kept, default=-1) + 1):
            images = self.rectified(pair)
            room -= sum(one.nbytes for one in images)
            if room >= 0:
                self.kept[frame] = images
            yield frame, images

    def pairs(self, start: int = 0) -> Iterator[tuple[int, Recorded]]:
        """Yield number and pair of the frames that have a place, one in memory at a time."""
        first = max(start, int(np.argmax(self.placed)))
        frames = range(first, len(self.placed))
        pairs = zip(frames, self.source.frames(first), strict=False)
        for frame, pair in tracked(pairs, "images", total=len(frames)):
            if self.placed[frame]:
                yield frame, pair


def open_images(map_: Map, moved: Sequence[Path] = ()) -> list[DriveImages]:
    """Open the linked drives of a map again, or raise a `ReconError` if one is not as it was.

    ``moved`` is where drives are now that are not where they were, by the names of their folders if
    there are several.
    """
    return [open_drive(map_, session, moved) for session in map_.linked]


def open_drive(map_: MapFile, session: Session, moved: Sequence[Path] = ()) -> DriveImages:
    """Open one of the linked drives of a map again, as `open_images` does."""
    alone = len(map_.linked) == 1
    named = [path for path in moved if alone or resolved(path).name == session.info.source]
    try:
        source = _opened(session, named[0] if named else None)
        rig = _rig(session, source)
    except ReconError as error:
        hint = "name the drive, as it was mapped, with --images"
        raise error.copy_with(hint=error.hint or hint) from error
    prefix = "" if alone else f"{session.number}_"
    return DriveImages(session, map_.placed[session.number], prefix, source, rig)


def _opened(session: Session, moved: Path | None) -> StereoSource:
    info = session.info
    with reading(session.where):
        known = {"source": None, "kind": None, "mark": {}, **info.start.get(IMAGES, {})}
        path, kind = moved or (known["source"] and Path(known["source"])), known["kind"]
        mark = {"frames": info.frames, **known["mark"]}
        street = StreetSettings.parse(info.config.get("street", {}))
        settings = SourceSettings.parse(info.config.get("source", {}))
    if info.description == SyntheticSource.description:
        source: StereoSource = SyntheticSource(street)
    elif path is None:
        what = "the map does not say where the images of the drive are"
        raise SourceError(what, where=session.where, got=info.source)
    else:
        source = open_source(path, kind, settings)
    found = mark_of(source)
    if found | mark != found:
        what = "files of the drive were added, changed or renamed since it was mapped"
        raise SourceError(what, where=path or source.name)
    return source


def _rig(session: Session, source: StereoSource) -> Rig:
    """Return the rig that a drive was mapped with: that which gives the camera of the map."""
    shown, settings = session.rig, settings_of(session).rectification
    rigs = [source.calibration] if shown is None else [shown.calibration, source.calibration]
    for rig in rigs:
        if turns_of(rig, settings).camera == session.camera:
            return rig
    what, got = "the rig of the drive is not that of the map", rigs[-1]
    raise SourceError(what, where=session.info.source, got=got, expected=session.camera)
