"""`recon audit --out`: the report of an audit."""

from __future__ import annotations

from pathlib import Path

from recon.commands.config import ReconConfig
from recon.report.audit_page import write_audit_page
from recon.rig.audit.run import Audit
from recon.run import Run
from recon.sources import StereoSource
from recon.stereo.match import make_matcher


def write_audit(audit: Audit, source: StereoSource, config: ReconConfig, out: Path) -> None:
    """Write ``report.html``, ``config.yaml``, ``summary.json`` and ``run.json`` of an audit.

    Raises:
        OutputError: A file cannot be written; then the folder is left as it was.
    """
    summary = audit.summary
    summary["warnings"] = [finding.text for finding in audit.findings]
    with Run("audit", out, config) as run:
        matcher = make_matcher(config.matching.matcher, config.matching, None)
        with run.report(summary):
            write_audit_page(audit, source, matcher, run)
        run.finish(summary, source=source.name, inputs=source.files)
