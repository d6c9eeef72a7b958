"""Audit of a recording: measures of images and matched features, and a verdict on usability."""

from recon.audit.alignment import RowAlignment, align_rows, count_aligned, mend_rig
from recon.audit.exposure import measure_gain
from recon.audit.findings import Finding, Verdict, verdict_of
from recon.audit.focus import measure_sharpness
from recon.audit.motion import measure_speed, measure_time_skew, track
from recon.audit.repeats import RepeatCounter
from recon.audit.settings import AuditSettings

__all__ = [
    "AuditSettings",
    "Finding",
    "RepeatCounter",
    "RowAlignment",
    "Verdict",
    "align_rows",
    "count_aligned",
    "measure_gain",
    "measure_sharpness",
    "measure_speed",
    "measure_time_skew",
    "mend_rig",
    "track",
    "verdict_of",
]
