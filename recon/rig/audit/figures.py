"""The figures of an audit, ready for JSON."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from recon.core.geometry.triangulation import depth_sigma
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.rig.audit import RowAlignment
from recon.rig.audit.geometry import Geometry
from recon.rig.audit.problems import Gaps
from recon.rig.audit.sample import Sample
from recon.run.summary import plain
from recon.sources import IncompleteSource, StereoSource

RANGES_M: Final = (2.0, 5.0, 10.0, 20.0, 50.0)
"""Distances for which the depth error is predicted."""

# No matcher is more accurate than a twentieth of a pixel on real images.
_LEAST_SIGMA_PX: Final = 0.05


def audit_figures(
    source: StereoSource, sample: Sample, geometry: Geometry, gaps: Gaps, camera: RectifiedCamera
) -> dict[str, Any]:
    """Return all measures of the audit; None if unknown."""
    sharpness = np.median(sample.sharpness, axis=0).tolist() if sample.sharpness else [None, None]
    gains = np.concatenate([np.zeros(0), *sample.gains])
    return {
        "source": source.name,
        "description": source.description,
        "frames": len(source),
        "frames_left_out": source.left_out if isinstance(source, IncompleteSource) else 0,
        "frames_read": sample.frames,
        "repeated_frames": sample.repeats.both,
        "frozen_left_frames": sample.repeats.frozen[0],
        "frozen_right_frames": sample.repeats.frozen[1],
        "gaps": gaps.count,
        "longest_step_s": plain(gaps.longest_s),
        "usual_step_s": plain(gaps.usual_s),
        "gain": float(np.median(gains)) if len(gains) else None,
        "sharpness_left": sharpness[0],
        "sharpness_right": sharpness[1],
        "features": len(geometry.features),
        "swapped_share": plain(geometry.swapped_share),
        "lag_frames": geometry.lag,
        "time_skew_frames": None if geometry.skew is None else geometry.skew[0],
        "baseline_m": camera.baseline_m,
        "focal_px": camera.focal_px,
        "field_of_view_deg": camera.field_of_view_deg,
        "speed_m_per_s": float(np.median(sample.speeds_m_per_s)) if sample.speeds_m_per_s else None,
        **_row_figures(geometry.alignment),
        **_depth_figures(geometry.alignment, geometry.disparity_px, camera),
    }


def _row_figures(alignment: RowAlignment | None) -> dict[str, Any]:
    if alignment is None:
        return {}
    return {
        "row_error_mean_px": alignment.mean_px,
        "row_error_spread_px": alignment.spread_px,
        "row_error_rms_px": alignment.rms_px,
        "row_noise_px": alignment.residual_px,
        "mend_pitch_deg": float(np.degrees(alignment.pitch_rad)),
        "mend_roll_deg": float(np.degrees(alignment.roll_rad)),
    }


def _depth_figures(
    alignment: RowAlignment | None, disparity_px: Float64, camera: RectifiedCamera
) -> dict[str, Any]:
    """Return observed disparities, and the depth error if columns are as accurate as rows."""
    if alignment is None or not len(disparity_px):
        return {}
    sigma_px = np.float32(max(alignment.residual_px, _LEAST_SIGMA_PX))
    errors = depth_sigma(np.array(RANGES_M, np.float32), sigma_px, camera)
    return {
        "disparity_5_50_95_px": np.quantile(disparity_px, [0.05, 0.5, 0.95]).tolist(),
        "depth_error_m": {f"{r:g}": float(e) for r, e in zip(RANGES_M, errors, strict=True)},
    }
