"""Reports of runs: figures, tables and one self-contained HTML file."""

from recon.reports.audit_report import present_audit
from recon.reports.calibration_report import present_calibration
from recon.reports.html import ReportContent, render_html
from recon.reports.map_report import MapReportInputs, map_report
from recon.reports.pair_report import PairReportInputs, pair_report
from recon.reports.paper_report import paper_report
from recon.reports.present import present_disparity, present_map, present_pair, present_paper
from recon.reports.rectify_pictures import present_rectify

__all__ = [
    "MapReportInputs",
    "PairReportInputs",
    "ReportContent",
    "map_report",
    "pair_report",
    "paper_report",
    "present_audit",
    "present_calibration",
    "present_disparity",
    "present_map",
    "present_pair",
    "present_paper",
    "present_rectify",
    "render_html",
]
