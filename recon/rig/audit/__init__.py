"""Audit of a recording: measures of images and matched features, and a verdict on usability."""

from recon.rig.audit.audit import Audit, audit_source, mend_calibration, quick_warnings
from recon.rig.audit.findings import Finding

__all__ = ["Audit", "Finding", "audit_source", "mend_calibration", "quick_warnings"]
