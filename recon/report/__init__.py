"""Reports of runs: figures, tables and one self-contained HTML file."""

from recon.report.audit_report import present_audit
from recon.report.calibration_report import present_calibration
from recon.report.html import ReportContent, render_html
from recon.report.map_report import MapReportInputs, map_report
from recon.report.pair_report import PairReportInputs, pair_report
from recon.report.paper_report import paper_report
from recon.report.present import present_disparity, present_map, present_pair, present_paper
from recon.report.rectify_pictures import present_rectify

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
