"""Audit of a recording: measures of images and matched features, and a verdict on usability."""

from recon.rig.audit.alignment import RowAlignment, align_rows, count_aligned, mend_rig
from recon.rig.audit.exposure import measure_gain
from recon.rig.audit.findings import Finding, Verdict, verdict_of
from recon.rig.audit.focus import measure_sharpness
from recon.rig.audit.motion import measure_speed, measure_time_skew, track
from recon.rig.audit.repeats import RepeatCounter
from recon.rig.audit.settings import AuditSettings

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
