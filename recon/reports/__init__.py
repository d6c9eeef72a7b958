"""What a run looks like: figures, tables and one HTML file that needs no network."""

from recon.reports.html import ReportContent, render_html
from recon.reports.map_report import MapReportInputs, map_report
from recon.reports.pair_report import PairReportInputs, pair_report

__all__ = [
    "MapReportInputs",
    "PairReportInputs",
    "ReportContent",
    "map_report",
    "pair_report",
    "render_html",
]
