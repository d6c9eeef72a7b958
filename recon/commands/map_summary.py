"""What commands found that make or join maps, or export one: the figures, and the terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import Final

from typing_extensions import Self

from recon.core.dates import DateFrom
from recon.core.summary import (
    Figures,
    Rows,
    RunSummary,
    hidden,
    inline,
    inline_each,
    named,
    optional,
    shown_path,
)
from recon.core.text import counted, length, metres
from recon.core.values import MapMetrics, OccupancyMetrics, TrajectoryMetrics
from recon.core.values.arrays import Float64
from recon.export.cloud import CloudFigures
from recon.export.make import PRODUCTS, Products
from recon.export.mesh.pieces import WHOLE, MeshFigures
from recon.export.occupancy import GridFigures, OctomapFigures
from recon.export.pair import PAIR_CLOUD
from recon.export.product import ProductFigures
from recon.look.rig import RigFigures
from recon.map.drive.drive_loops import LoopFigures
from recon.map.drive.drive_odometry import UsedPrior
from recon.map.drive.sequence import DriveSegment
from recon.map.sessions.georeference import SurveyFigures
from recon.map.store.trees import Forgotten
from recon.odometry.imu_fit import ImuFigures
from recon.odometry.sfm import SfmFigures
from recon.sources.source import SourceFigures

_MOST_ROWS: Final = 4  # products that the terminal names, each in a line


@dataclass(frozen=True, kw_only=True)
class UsualProducts(Figures):
    """What is made of every map."""

    cloud: CloudFigures = inline()
    octomap: OctomapFigures = inline()
    grid: GridFigures = inline()
    mesh: MeshFigures = inline()

    @classmethod
    def of(cls, made: Products) -> Self:
        """Return the figures of products; without a mesh it has no faces."""
        return cls(
            cloud=made.figures_of(CloudFigures),
            octomap=made.figures_of(OctomapFigures),
            grid=made.figures_of(GridFigures),
            mesh=made.figures_of(MeshFigures) if "mesh" in made.made else MeshFigures(),
        )

    def rows(self) -> Rows:
        return [
            ("cloud", PRODUCTS["cloud"].name, self.cloud.text),
            ("grid", PRODUCTS["grid"].name, self.grid.text),
            *([("mesh", WHOLE, self.mesh.text)] if self.mesh.faces else []),
        ]


@dataclass(frozen=True, kw_only=True)
class PriorFigures(Figures):
    """How a trajectory of other sensors was used."""

    origin: str = named("from")
    use: UsedPrior = inline()


@dataclass(frozen=True, kw_only=True)
class MapSummary(RunSummary):
    """What `recon map`, `demo` and `live` made of a drive; None = it is not known."""

    odometry: str
    source: str
    frames: int
    fps: float | None  # frames in a second of mapping
    frames_joined: int  # that have a place in the map
    segments: Sequence[DriveSegment]  # segments of the path
    path_length_m: float
    expected_drift_percent: float | None  # standard deviation of a position, of the path up to it
    expected_drift_rig_percent: float | None  # the part that is due to the rig
    frames_not_trusted: int
    focal_px: float  # of the rectified images
    field_of_view_deg: float
    T_map_world: Float64  # (4, 4)
    scale: float  # that lengths of the settings were multiplied by
    voxel_m: float
    largest_voxel_m: float  # far away
    reach_m: float  # depth up to which points are fused; infinite = any
    reach_error_m: float  # of a depth there, in one frame, by a matching error of 0.3 px
    typical_depth_m: float | None
    date: str  # of the first image, UTC; "" = not known
    date_from: DateFrom
    map_mb_per_km: float | None  # size of map.recon, by the path
    made: UsualProducts = inline()
    rig: RigFigures
    loops: LoopFigures | None = optional()
    imu: ImuFigures | None = optional()
    base_frame: str | None = optional()  # of the robot, as its static transforms have it
    sfm: SfmFigures | None = optional()
    trajectory: TrajectoryMetrics | None = optional()  # errors, where the truth is known
    map: MapMetrics | None = optional()
    occupancy: OccupancyMetrics | None = optional()
    read: SourceFigures = inline()
    prior: PriorFigures | None = optional()

    def rows(self) -> Rows:
        doubted = f", {self.frames_not_trusted} not trusted" if self.frames_not_trusted else ""
        drift = self.expected_drift_percent
        expected = "" if drift is None else f" · drift expected {drift:.2g} %"
        path = f"{metres(self.path_length_m)} of path{expected}"
        rate = () if self.fps is None else (f"maps {self.fps:.1f} frames/s",)
        live = self.read.live
        time_offset_ms = None if live is None else live.latency_ms.p95
        poses = () if time_offset_ms is None else (f"95 % of poses in {time_offset_ms:.0f} ms",)
        made, accuracy = self.made.rows(), self._accuracy() or self._base()
        # Eight lines: the last one names the folder, too.
        full = bool(self.made.mesh.faces and accuracy)
        return [
            (f"map of {counted(self.frames, 'frame')}{doubted}, {path}",),
            *([] if full else self.folder_row()),
            ("maps", f"{self._reach()}, {self.made.grid.level.text}"),
            *made,
            *accuracy,
            *self.cost_row(*rate, *poses),
            ("next", self.open_view()),
        ]

    def _reach(self) -> str:
        near, far = length(self.voxel_m), length(self.largest_voxel_m)
        voxels = f"voxels of {near}" + ("" if near == far else f" to {far}")
        if not math.isfinite(self.reach_m):
            return f"all depths, {voxels}"
        at = length(self.reach_m)
        return f"up to {at}, {voxels}, ± {length(self.reach_error_m)} at {at}"

    def _accuracy(self) -> Rows:
        """Return how far path and surface are off the truth, as far as that is known."""
        parts = []
        if (path := self.trajectory) is not None:
            parts.append(f"drift {path.t_rel_percent:.2g} %, ATE {metres(path.ate_m)} (RMS)")
        if (surface := self.map) is not None:
            near = f"within {surface.threshold_m:g} m"
            parts.append(f"{100 * surface.precision:.0f} % of the points {near}")
        return [("accuracy", "; ".join(parts))] if parts else []

    def _base(self) -> Rows:
        said = f"{self.base_frame}, by the robot's static transforms"
        return [] if self.base_frame is None else [("base", "trajectory_map_base_tum.txt", said)]


@dataclass(frozen=True, kw_only=True)
class JoinedDrive(Figures):
    """A drive of a map of several."""

    number: int
    name: str
    frames: int
    length_m: float
    linked: bool  # whether it is linked with the first
    frames_not_trusted: int
    frames_placed: int
    positions: int  # measured positions that constrain it
    rig: RigFigures | None  # None = its motion was not looked at
    date: str  # of its first image, UTC; "" = not known
    date_from: DateFrom
    rays_kept: float  # fraction of them that newer drives did not see again
    keyframes_kept: float


@dataclass(frozen=True)
class LinkFigures(Figures):
    """Places that two drives saw."""

    count: int
    refused: int  # that contradict the others
    pairs: Mapping[str, int]  # by the numbers of two drives, such as ``0-1``


@dataclass(frozen=True, kw_only=True)
class JoinedSummary(RunSummary):
    """What `recon merge`, `map --into` and `--remove` made of several drives."""

    frames: int  # of the linked drives
    path_length_m: float
    sessions: Sequence[JoinedDrive]
    links: LinkFigures
    positions_misfit_rms_m: float | None  # None = no position was measured
    forgotten: Sequence[Forgotten]  # drives that left the map, since it was made
    map_mb_per_km: float | None  # size of map.recon, by the paths of the drives in it
    tended: str = hidden("")  # what was forgotten now
    changes: Mapping[str, int] | None = optional()  # objects that ``came`` or ``went``
    made: UsualProducts = inline()
    T_map_world: Float64  # (4, 4)

    def rows(self) -> Rows:
        drives, linked = len(self.sessions), sum(one.linked for one in self.sessions)
        apart = "" if linked == drives else f" of {drives}"
        places = f"{counted(self.links.count, 'place')} seen by two drives"
        misfit_m = self.positions_misfit_rms_m
        off = "" if misfit_m is None else f"{metres(misfit_m)} off measured positions (RMS)"
        held = ", ".join(text for text in (places if drives > 1 else "", off) if text)
        path = f"{counted(self.frames, 'frame')}, {metres(self.path_length_m)} of path"
        news = "".join(f", {n} {change}" for change, n in (self.changes or {}).items())
        full = bool(self.tended and self.made.mesh.faces)
        return [
            (f"map of {linked}{apart} {'drive' if drives == 1 else 'drives'}, {path}{news}",),
            *self.folder_row(),
            *self.made.rows(),
            *([("forgot", self.tended)] if self.tended else []),
            # Eight lines: what was forgotten is news.
            *([("links" if drives > 1 else "survey", held)] if held and not full else []),
            *self.cost_row(),
            ("next", self.open_view()),
        ]


@dataclass(frozen=True, kw_only=True)
class PieceSummary(RunSummary):
    """A piece of a drive that a worker mapped."""

    frames: int


@dataclass(frozen=True, kw_only=True)
class ExportSummary(RunSummary):
    """What `recon export`, `mesh` and `occupancy` made of the map of a run."""

    run: str  # folder of the run
    frames: int
    survey: SurveyFigures | None = inline(None)  # where the map is in its coordinates
    products: Mapping[str, ProductFigures] = inline_each()
    T_map_world: Float64  # (4, 4)

    def rows(self) -> Rows:
        made = [(name, PRODUCTS[name].name, one.text) for name, one in self.products.items()]
        most = _MOST_ROWS if self.survey is None else _MOST_ROWS - 1
        shown, others = (made, []) if len(made) <= most else (made[: most - 1], made[most - 1 :])
        rest = shorten(", ".join(name for name, *_ in others), 60, placeholder=" …")
        survey = self.survey
        place = [] if survey is None else [("survey", "accuracy.html", self._placed(survey))]
        return [
            (f"{counted(len(made), 'product')} of {self.run}",),
            *self.folder_row(),
            *shown,
            *([("and", rest)] if others else []),
            *place,
            *self.cost_row(),
            ("next", self._next()),
        ]

    def _placed(self, found: SurveyFigures) -> str:
        points = "control points" if found.control else "positions"
        return f"{found.positions} {points}, {metres(found.misfit_rms_m)} off the map (RMS)"

    def _next(self) -> str:
        """Return the command that opens what was made."""
        out = self.out or ""
        if "mesh" in self.products:
            return f"meshlab {shown_path(out, 'mesh', 'mesh.mlp')}"
        for name in ("grid", "costmap"):
            if name in self.products:
                file = shown_path(out, PRODUCTS[name].name)
                return f"ros2 run nav2_map_server map_server --ros-args -p yaml_filename:={file}"
        if "web" in self.products:
            folder = shown_path(out, PRODUCTS["web"].name)
            return f"python -m http.server --bind 127.0.0.1 --directory {folder}"
        return f"recon view {shown_path(self.run)}"


@dataclass(frozen=True, kw_only=True)
class CloudSummary(RunSummary):
    """What was made of a cloud file, or of the cloud of a pair."""

    cloud: str  # the file
    run: str | None = optional()  # folder of the run of the pair
    mesh: MeshFigures | None = inline(None)

    def rows(self) -> Rows:
        mesh, out = self.mesh, self.out or ""
        file = PAIR_CLOUD if mesh is None else str(Path("mesh", "mesh.mlp"))
        return [
            (f"{'cloud' if mesh is None else 'surface'} of {self.cloud}",),
            *self.folder_row(),
            *([] if mesh is None else [("mesh", WHOLE, mesh.text)]),
            *self.cost_row(),
            ("next", f"meshlab {shown_path(out, file)}"),
        ]
