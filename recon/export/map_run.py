"""The results of a mapped drive, and their figures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from recon.core.text import counted
from recon.core.values import (
    MapMetrics,
    OccupancyGrid,
    OccupancyMetrics,
    PointCloud,
    SequenceTruth,
    TrajectoryMetrics,
    TriangleMesh,
)
from recon.export.make import Products
from recon.map.drive.sequence import MappedSequence
from recon.map.settings import DriveSettings
from recon.run.run import plain


@dataclass(frozen=True, eq=False)
class MapRun:
    """Results of a run, from which its report is made.

    Attributes:
        name: Display name of the source.
        config: The configuration.
        mapped: Trajectory, health, fused cloud, voxels.
        made: What was made of the map.
        truth: Ground truth of path and surface, as far as the source knows it.
        metrics: Errors against the true path, or None without one.
        map_metrics: Errors against the true surface, or None without one.
        occupancy_metrics: Errors against the true occupancy, or None without one.
        warnings: Problems that did not stop the run.
        summary: The figures of ``summary.json``.
    """

    name: str
    config: DriveSettings
    mapped: MappedSequence
    made: Products
    truth: SequenceTruth | None
    metrics: TrajectoryMetrics | None
    map_metrics: MapMetrics | None
    occupancy_metrics: OccupancyMetrics | None
    warnings: tuple[str, ...]
    summary: dict[str, Any] = field(default_factory=dict)

    @property
    def cloud(self) -> PointCloud:
        """Even sample of the fused cloud; all points of a small one. Frame ``map``."""
        return self.made.cloud

    @property
    def grid(self) -> OccupancyGrid:
        """The flat grid."""
        return self.made.grid

    @property
    def mesh(self) -> TriangleMesh | None:
        """The surface in map axes; None = not wanted, not possible, or too large for memory."""
        return self.made.mesh

    def __repr__(self) -> str:
        made = f"{self.mapped}, {self.grid}, {self.mesh}"
        return f"MapRun({self.name!r}, {made}, {counted(len(self.warnings), 'warning')})"

    def figures(self) -> dict[str, Any]:
        """Return the figures of path, map and errors."""
        mapped = self.mapped
        frames, seconds = len(mapped.trajectory), mapped.seconds
        drift = mapped.expected_drift
        errors = {
            "trajectory": self.metrics,
            "map": self.map_metrics,
            "occupancy": self.occupancy_metrics,
        }
        return {
            "source": self.name,
            "frames": frames,
            "fps": frames / seconds if seconds > 0 else None,
            "path_length_m": mapped.trajectory.path_length_m,
            "expected_drift_percent": None if drift is None else drift.percent,
            "expected_drift_rig_percent": None if drift is None else drift.rig_percent,
            "frames_not_trusted": int((~mapped.trusted).sum()),
            "focal_px": mapped.camera.focal_px,
            "field_of_view_deg": mapped.camera.field_of_view_deg,
            "T_map_world": mapped.T_map_world.tolist(),
            "faces": 0,
            **self.made.figures,
            "warnings": list(self.warnings),
            **({} if mapped.loops is None else {"loops": mapped.loops.figures()}),
            **{name: plain(known) for name, known in errors.items() if known is not None},
        }
