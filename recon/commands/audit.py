"""`recon audit`: is a recording good enough for a long run?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from recon.commands.config import ReconConfig
from recon.io.atomic import check_targets
from recon.io.files import StrPath
from recon.report.audit_page import write_audit_page
from recon.rig.audit.audit import Audit, audit_source, correct_calibration
from recon.run.run import Run
from recon.sources.source import StereoSource
from recon.stereo.match.registry import make_matcher


def run_audit(
    source: StereoSource,
    config: ReconConfig,
    *,
    quick: bool = False,
    mend: StrPath | None = None,
    out: StrPath | None = None,
) -> Audit:
    """Check a recording before a long run: what `recon audit` does.

    Some stretches of the recording are read, and features are matched in some of their pairs. What
    they say of rows, time, exposure, focus and calibration gives findings and a verdict.

    Args:
        source: The recording.
        config: The configuration; its ``audit``, ``rectification`` and ``matching`` are used.
        quick: A short check of a second or two, as `recon map` makes it.
        mend: File for a calibration that fits rows and motion; None = none is written.
        out: Folder for a report with images; None = none is written.

    Raises:
        CalibrationError: The calibration cannot rectify anything, or there are too few features to
            correct it.
        ReconError: The calibration or the report cannot be written, or would replace a file of the
            recording.
    """
    if mend is not None:
        check_targets([Path(mend)], source.files)
    audit = audit_source(source, config, quick=quick)
    if mend is not None:
        audit = replace(audit, corrected=correct_calibration(source, config, audit, Path(mend)))
    if out is not None:
        matcher = make_matcher(config.matching.matcher, config.matching, None)
        with Run("audit", out, config) as run:
            summary = audit.summary
            with run.report(summary):
                write_audit_page(audit, source, matcher, run)
            warnings = [finding.text for finding in audit.findings]
            record = {"warnings": warnings}
            run.finish(summary, source=source.name, inputs=source.files, record=record)
    return audit
