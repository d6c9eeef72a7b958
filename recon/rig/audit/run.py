"""`recon audit` without its command line: is a source good enough for a long run?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recon.core.errors import CalibrationError
from recon.core.values import RectifiedCamera
from recon.io.cameras.recon_yaml import write_recon_calibration
from recon.rig.audit import Finding, RowAlignment, Verdict, mend_rig, verdict_of
from recon.rig.audit.figures import audit_figures
from recon.rig.audit.geometry import measure_geometry
from recon.rig.audit.problems import (
    find_calibration_faults,
    find_gaps,
    find_geometry_faults,
    find_picture_faults,
    find_range_faults,
    find_series_faults,
)
from recon.rig.audit.sample import Look, take_sample
from recon.rig.audit.settings import AuditedSettings
from recon.sources import StereoSource
from recon.stereo.match import MatchingSettings, settings_of
from recon.stereo.match.search import SearchSettings
from recon.stereo.rectify import Rectifier, plan_turns


@dataclass(frozen=True, eq=False)
class Audit:
    """The result of an audit.

    Attributes:
        verdict: good, usable or not usable.
        findings: Problems found, fatal ones first.
        figures: All measures, ready for JSON.
        alignment: Row errors of all pairs together; None if there are too few features.
        looks: What was measured in each pair, and a few of the images.
    """

    verdict: Verdict
    findings: tuple[Finding, ...]
    figures: dict[str, Any]
    alignment: RowAlignment | None
    looks: tuple[Look, ...] = ()

    def __repr__(self) -> str:
        found = ", ".join(finding.code for finding in self.findings) or "no findings"
        return f"Audit({self.verdict!r}, {found})"

    @property
    def summary(self) -> dict[str, Any]:
        """The content of ``--json``."""
        findings = [
            {"code": f.code, "severity": "fatal" if f.fatal else "warning", "text": f.text}
            for f in self.findings
        ]
        return {"verdict": self.verdict, "findings": findings, **self.figures}


def run_audit(source: StereoSource, config: AuditedSettings, *, quick: bool = False) -> Audit:
    """Check a drive before a long run.

    Args:
        source: The drive.
        config: The configuration; its ``audit``, ``rectification`` and ``matching`` are used.
        quick: A short check of a second or two, as in `recon map`.

    Raises:
        CalibrationError: The calibration cannot rectify anything.
    """
    settings = config.audit
    rectifier = Rectifier(source.calibration, config.rectification)
    camera = rectifier.camera
    sample = take_sample(source, rectifier, settings, quick=quick)
    geometry = measure_geometry(sample, camera)
    gaps = find_gaps(source)
    reach_px = _reach_px(camera, config.matching)
    findings = [
        *find_picture_faults(sample, config.matching.matcher),
        *find_series_faults(sample, gaps),
        *find_geometry_faults(geometry),
        *find_range_faults(geometry, reach_px, camera),
        *find_calibration_faults(sample, source.calibration, camera, settings.baseline_m),
    ]
    findings.sort(key=lambda finding: not finding.fatal)
    figures = audit_figures(source, sample, geometry, gaps, camera)
    looks = tuple(sample.looks)
    return Audit(verdict_of(findings), tuple(findings), figures, geometry.alignment, looks)


def quick_warnings(source: StereoSource, config: AuditedSettings) -> tuple[str, ...]:
    """Return findings of a quick audit, one line each; none if it is switched off.

    A calibration that cannot rectify is reported by the run itself, not here.
    """
    if not config.audit.quick:
        return ()
    try:
        audit = run_audit(source, config, quick=True)
    except CalibrationError:
        return ()
    return tuple(f"{finding.text} [quick audit]" for finding in audit.findings)


def mend_calibration(
    source: StereoSource, config: AuditedSettings, audit: Audit, path: Path
) -> dict[str, Any]:
    """Write the calibration with the right camera rotated so that rows correspond.

    Returns:
        The rotation in degrees, and the remaining row error.

    Raises:
        CalibrationError: There are too few features to measure the row error.
        OutputError: The file cannot be written.
    """
    alignment = audit.alignment
    if alignment is None:
        raise CalibrationError(
            "too few features to correct the calibration",
            where=source.name,
            hint="record scenes with more texture, or recalibrate the cameras",
        )
    rig = source.calibration
    if isinstance(rig, RectifiedCamera):
        left = np.eye(3)
    else:
        left = plan_turns(rig, config.rectification).R_left
    figures = {
        "pitch_deg": float(np.degrees(alignment.pitch_rad)),
        "roll_deg": float(np.degrees(alignment.roll_rad)),
        "row_error_before_px": alignment.rms_px,
    }
    write_recon_calibration(path, mend_rig(rig, alignment, left), figures)
    return {**figures, "calibration": str(path)}


def _reach_px(camera: RectifiedCamera, matching: MatchingSettings) -> int | None:
    """Return the largest disparity that is searched; None if the range adapts to each pair."""
    own = settings_of(matching.matcher, matching)
    if not isinstance(own, SearchSettings):
        return None
    if own.ndisp is None and camera.ndisp is None:
        return None
    return own.min_disparity_px + own.ndisp_for(camera)
