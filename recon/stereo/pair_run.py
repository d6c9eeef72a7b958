"""What a run of `recon pair` or `recon disparity` gives, and its figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    PointCloud,
    Reason,
    RectifiedPair,
    TriangleMesh,
)
from recon.core.words import counted
from recon.stereo.frame import ReconstructedFrame
from recon.stereo.settings import StereoSettings


@dataclass(frozen=True, eq=False)
class PairRun:
    """Results of a run, from which its report is made.

    Attributes:
        name: Display name of the pair.
        config: The configuration.
        pair: The rectified images.
        disparity: Their disparity.
        summary: The figures of ``summary.json``.
        cloud: The points in camera axes, or None if only the disparity was requested.
        mesh: The surface in camera axes, or None.
        truth: True disparity, or None.
        metrics: Errors against it, or None.
        warnings: Problems that did not stop the run.
    """

    name: str
    config: StereoSettings
    pair: RectifiedPair
    disparity: Disparity
    summary: dict[str, Any]
    cloud: PointCloud | None = None
    mesh: TriangleMesh | None = None
    truth: DisparityTruth | None = None
    metrics: DisparityMetrics | None = None
    warnings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        parts = (self.disparity, self.cloud, self.mesh)
        made = ", ".join(repr(part) for part in parts if part is not None)
        return f"PairRun({self.name!r}, {made}, {counted(len(self.warnings), 'warning')})"


def disparity_figures(disparity: Disparity) -> dict[str, Any]:
    """Return size, share of pixels for each reason, and median of a disparity, ready for JSON."""
    found = disparity.values[disparity.valid]
    shares = disparity.reason_shares
    return {
        "width_px": disparity.values.shape[1],
        "height_px": disparity.values.shape[0],
        "valid_percent": 100.0 * float(disparity.valid.mean()),
        "reasons_percent": {r.name.lower(): 100.0 * shares.get(r, 0.0) for r in Reason},
        "disparity_median_px": float(np.median(found)) if len(found) else None,
    }


def cloud_figures(frame: ReconstructedFrame) -> dict[str, Any]:
    """Return the number of points, median depth and camera of a frame, ready for JSON."""
    camera, z = frame.pair.camera, frame.cloud.xyz[:, 2]
    return {
        "points": len(frame.cloud),
        "depth_median_m": float(np.median(z)) if len(z) else None,
        "focal_px": camera.focal_px,
        "field_of_view_deg": camera.field_of_view_deg,
        "cx_px": camera.cx_px,
        "cy_px": camera.cy_px,
        "baseline_m": camera.baseline_m,
        "doffs_px": camera.doffs_px,
    }
