"""What a run of one pair found: its disparity, cloud and mesh, and their accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from recon.core.summary import Figures, Rows, RunSummary, inline, optional, shown_path
from recon.core.text import metres
from recon.core.values import DisparityMetrics
from recon.export.mesh.pieces import WHOLE
from recon.export.pair import PAIR_CLOUD
from recon.stereo.match.onnx import NetworkFigures

_SHOWN_PX = 2.0  # errors that the terminal counts: half the threshold of the benchmark's table


@dataclass(frozen=True)
class DisparityAccuracy(Figures):
    """Errors against the true disparity, of all pixels and of each of two kinds alone."""

    every: DisparityMetrics = inline()
    measured: DisparityMetrics | None = optional()
    inferred: DisparityMetrics | None = optional()


@dataclass(frozen=True, kw_only=True)
class DisparityFigures(Figures):
    """How much of a disparity was measured, and how good it is.

    What was measured and what was inferred are counted apart; ``filled_percent`` is what
    ``inferred_percent`` was called.
    """

    pair: str
    width_px: int
    height_px: int
    valid_percent: float  # of the pixels, those that were measured
    inferred_percent: float
    filled_percent: float
    reasons_percent: Mapping[str, float]
    disparity_median_px: float | None  # of what was measured; None = nothing was
    accuracy: DisparityAccuracy | None = optional("disparity")  # where the truth is known
    network: NetworkFigures | None = optional()
    disparity_png_scale: float | None  # grey levels per pixel; None = there is no PNG

    @property
    def sentence(self) -> str:
        """How much was measured, and how much inferred."""
        inferred = f", {self.inferred_percent:.0f} % inferred" if self.inferred_percent else ""
        name = Path(self.pair).name or "pair"
        return f"{name}: {self.valid_percent:.0f} % of the pixels measured{inferred}"

    def rows(self) -> Rows:
        """Return where the disparity is, and how good."""
        size, median_px = f"{self.width_px} × {self.height_px} px", self.disparity_median_px
        median = "" if median_px is None else f", median disparity {median_px:.1f} px"
        rows: Rows = [("disparity", "disparity/disparity.pfm", size + median)]
        if self.accuracy is None:
            return rows
        found = self.accuracy.every
        bad = found.bad.get(_SHOWN_PX)
        off = "" if bad is None else f", {bad:.1f} % of the pixels off by > {_SHOWN_PX:g} px"
        return [*rows, ("accuracy", f"mean error {found.avgerr_px:.2f} px{off}")]


@dataclass(frozen=True, kw_only=True)
class DisparitySummary(RunSummary):
    """What `recon disparity` found."""

    disparity: DisparityFigures = inline()

    def rows(self) -> Rows:
        picture = shown_path(self.out or "", "disparity", "disparity_colour.png")
        return [
            (self.disparity.sentence,),
            *self.folder_row(),
            *self.disparity.rows(),
            *self.cost_row(),
            ("next", f"xdg-open {picture}"),
        ]


@dataclass(frozen=True, kw_only=True)
class PairCloud(Figures):
    """The cloud of a pair, and the camera that sees it."""

    points: int
    inferred_points: int | None = optional()
    depth_median_m: float | None  # of what was measured; None = nothing was
    focal_px: float
    field_of_view_deg: float
    cx_px: float
    cy_px: float
    baseline_m: float
    doffs_px: float


@dataclass(frozen=True, kw_only=True)
class PairSummary(RunSummary):
    """What `recon pair` found."""

    disparity: DisparityFigures = inline()
    cloud: PairCloud = inline()
    faces: int  # of the surface; 0 = there is none
    mesh_coverage: float | None  # fraction of the measured points on it; None = there is none
    up_to_scale: bool  # whether depth has no unit

    def rows(self) -> Rows:
        found, out = self.cloud, shown_path(self.out or "")
        deep, ratio = found.depth_median_m, self.mesh_coverage
        depth = "" if deep is None else f", median depth {metres(deep)}"
        cloud = f"{found.points:,} points" + (", up to scale" if self.up_to_scale else depth)
        covered = "" if ratio is None else f", {100 * ratio:.0f} % covered"
        mesh = ("mesh", WHOLE, f"{self.faces:,} faces{covered}")
        return [
            (self.disparity.sentence,),
            *self.folder_row(),
            *self.disparity.rows(),
            ("cloud", PAIR_CLOUD, cloud),
            *([mesh] if self.faces else []),
            *self.cost_row(),
            ("next", self.open_view() if self.faces else f"recon mesh {out}"),
        ]
