"""What commands say when they are done: a few lines, and the JSON that they stand for."""

import json
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from recon.cli.tables import print_summary
from recon.commands.batch import BatchSummary
from recon.commands.diff import DiffSummary
from recon.commands.map_summary import (
    CloudSummary,
    ExportSummary,
    JoinedDrive,
    JoinedSummary,
    LinkFigures,
    MapSummary,
    UsualProducts,
)
from recon.core.summary import (
    Figures,
    RunSummary,
    Summary,
    inline,
    inline_each,
    named,
    optional,
    to_json,
)
from recon.core.values import (
    DisparityMetrics,
    GridMetrics,
    MapMetrics,
    OccupancyMetrics,
    TrajectoryMetrics,
    VoxelMetrics,
)
from recon.evaluation import paper
from recon.evaluation.middlebury.bench import MiddleburySummary
from recon.evaluation.pair_summary import (
    DisparityAccuracy,
    DisparityFigures,
    DisparitySummary,
    PairCloud,
    PairSummary,
)
from recon.evaluation.summary import (
    DisparityEvaluation,
    MapEvaluation,
    OccupancyEvaluation,
    Placement,
    ThresholdFigures,
    TrajectoryEvaluation,
)
from recon.export.cloud import CloudFigures
from recon.export.make import PRODUCTS
from recon.export.mesh.pieces import MeshFigures
from recon.export.occupancy import GridFigures, OctomapFigures
from recon.export.product import PointFigures
from recon.look.rig import RigFigures
from recon.map.ground.level import Level
from recon.map.localize.sequence import FrameSeconds, LocalizedFigures, LocalizeSummary
from recon.map.sessions.georeference import SurveyFigures
from recon.rig.audit import AuditFigures, AuditSummary, CorrectedFigures, Correction, FindingFigures
from recon.rig.board_sheet import BoardSummary
from recon.rig.calibrate.verdict import CalibrationFinding, CalibrationSummary
from recon.rig.capture import CaptureFigures, CaptureSummary
from recon.rig.rectification import ByCalibration, RectifySummary
from recon.run.batch.results import JobFacts, JobSummary
from recon.sources.source import Latency, LiveFigures, SourceFigures
from tests.scenery.calibrated import GOOD

MOST_LINES, COLUMNS = 8, 80
OUT = "outputs/map/2026-11-29T12-00-00Z"
COST: dict[str, Any] = {
    "seconds": 1234.5, "stages": {"match": 1200.0}, "peak_memory_mb": 12_345.6, "out": OUT,
}  # fmt: skip
DISPARITY = DisparityFigures(
    pair="scenes/Jadeplant/im0.png", width_px=2632, height_px=1988, valid_percent=83.21,
    inferred_percent=12.4, filled_percent=12.4, reasons_percent={"valid": 83.21},
    disparity_median_px=123.45, disparity_png_scale=256.0,
    accuracy=DisparityAccuracy(DisparityMetrics({2.0: 12.34}, 1.0, 1.234, 4.0, 100)),
)  # fmt: skip
PAIR = PairSummary(
    disparity=DISPARITY, faces=1_234_567, mesh_coverage=0.97, up_to_scale=False, **COST,
    cloud=PairCloud(
        points=4_123_456, depth_median_m=3.21, focal_px=1000.0, field_of_view_deg=60.0,
        cx_px=1.0, cy_px=1.0, baseline_m=0.5, doffs_px=0.0,
    ),
)  # fmt: skip
GRID = GridFigures(
    resolution_m=0.2, rows=5900, columns=2700, occupied_cells=1, free_cells=1,
    camera_height_m=1.65, T_base_camera=np.eye(4), level=Level("surfaces", 1.2),
)  # fmt: skip
MADE = UsualProducts(
    cloud=CloudFigures(12_345_678, 1234),
    octomap=OctomapFigures(123),
    grid=GRID,
    mesh=MeshFigures(points=1, vertices=2, faces=12_345_678, tiles=4),
)
PATH = TrajectoryMetrics(0.523, 0.21, 12.34, 0.02, 0.05, 1234.5, 1101, (100.0, 800.0), 99)
SURFACE = MapMetrics(0.2, 0.876, 0.5, 0.6, 0.05, 0.34, 12_345_678, 87_654_321)
MAP = MapSummary(
    odometry="visual", source="06", frames=1101, fps=12.34, frames_joined=1100, segments=(),
    path_length_m=1234.5, expected_drift_percent=0.25, expected_drift_rig_percent=0.1,
    frames_not_trusted=12, focal_px=700.0, field_of_view_deg=80.0, T_map_world=np.eye(4), scale=1.0,
    voxel_m=0.1, largest_voxel_m=0.1, reach_m=18.0, reach_error_m=0.25,
    typical_depth_m=12.5, date="2026-11-29T12:00:00Z", date_from="stamps", map_mb_per_km=12.3,
    made=MADE, rig=RigFigures(refined=True), trajectory=PATH, map=SURFACE,
    read=SourceFigures(), **COST,
)  # fmt: skip
LIVE = SourceFigures(
    live=LiveFigures(
        rate=1.0, frames_arrived=10, frames_dropped=0, frames_not_matched=1,
        latency_ms=Latency(12.0, 34.5, 99.0),
    )
)  # fmt: skip
JOINED = JoinedSummary(
    frames=2202, path_length_m=2345.6, links=LinkFigures(123, 1, {"0-1": 123}),
    positions_misfit_rms_m=0.034, forgotten=(), map_mb_per_km=12.3, made=MADE,
    T_map_world=np.eye(4), **COST,
    sessions=[
        JoinedDrive(
            number=n, name="06", frames=1101, length_m=1234.5, linked=n < 2, frames_not_trusted=0,
            frames_placed=1101, positions=0, rig=None, date="2026-11-29T12:00:00Z",
            date_from="stamps", rays_kept=0.5, keyframes_kept=0.5,
        )
        for n in range(3)
    ],
)  # fmt: skip
FOUND = LocalizedFigures(
    frames=1101, frames_searching=12, frames_tracking=1000, frames_coasting=89, frames_lost=2,
    first_fix_frame=12, median_sigma_m=0.034, fps=12.0,
    seconds_per_frame=FrameSeconds(0.04, 0.08, 0.5),
)  # fmt: skip
LOCALIZED = LocalizeSummary(
    source="06", map_run="outputs/map/latest", T_map_world=np.eye(4), drive=FOUND,
    rig=RigFigures(refined=False), read=SourceFigures(), **COST,
)  # fmt: skip
SURVEY = SurveyFigures(
    positions=1234, positions_left_out=12, misfit_rms_m=0.034, misfit_max_m=0.12, span_m=500.0,
    scale=1.0, tilt_deg=0.1, yaw_sigma_deg=0.1, rotation_sigma_deg=0.1, edge_sigma_m=0.1,
    T_survey_map=np.eye(4),
)  # fmt: skip
EXPORTED = ExportSummary(
    run=OUT, frames=1101, survey=SURVEY, T_map_world=np.eye(4), **COST,
    products={name: PointFigures(12_345_678) for name in list(PRODUCTS)[::2]},
)  # fmt: skip
AUDITED = AuditSummary(
    verdict="usable", out=OUT, findings=[FindingFigures("blur", "warning", "images are blurred")],
    figures=AuditFigures(
        source="06", description="KITTI", frames=1101, frames_left_out=0, frames_read=72,
        repeated_frames=3, frozen_left_frames=0, frozen_right_frames=0, gaps=1, longest_step_s=0.2,
        usual_step_s=0.1, gain=1.0, sharpness_left=0.5, sharpness_right=0.5, features=1000,
        swapped_ratio=0.0, time_offset_frames=0, time_skew_frames=0.0, baseline_m=0.537,
        focal_px=707.0, field_of_view_deg=80.0, speed_m_per_s=10.0, epipolar_error_rms_px=0.23,
        depth_error_m={"10": 0.045},
    ),
    repaired=CorrectedFigures(
        correction=Correction(epipolar_error_before_px=1.0, pitch_deg=0.1, roll_deg=0.1),
        calibration="repaired.yaml", files=["repaired.yaml"],
    ),
)  # fmt: skip
CALIBRATED = CalibrationSummary(
    figures=GOOD, model="radtan", verdict="good", frames_left_out=0, files=["rig.yaml"], **COST,
    findings=[CalibrationFinding("tilt", "note", "tilt the board more")],
)  # fmt: skip
BY_CALIBRATION = ByCalibration(focal_px=700.0, field_of_view_deg=80.0, baseline_m=0.12)
RECTIFIED = RectifySummary(
    pair="0.png", plan=BY_CALIBRATION, features=1234, pairs=1101, frames_left_out=0,
    epipolar_error_px=0.12, epipolar_error_median_px=0.1, epipolar_error_95_px=0.34, **COST,
)  # fmt: skip
CAPTURED = CaptureSummary(
    started_utc="2026-11-29T12:00:00+00:00", devices=["0", "2"], exposure_locked=True,
    calibration=False, out="rides/today",
    figures=CaptureFigures(
        frames=1101, seconds=36.7, rate_hz=30.0, gaps=2, skew_mean_ms=1.2, skew_max_ms=12.3
    ),
)  # fmt: skip
VOXELS, CELLS = VoxelMetrics(0.9, 0.8, 123_456, 123), GridMetrics(0.9, 0.8, 0.01, 0.2, 10, 5)
ERRORS = {"avgerr": 1.23, "d1": 12.3, "bad": {"2": 12.3}, "rms": 4.0}
METHOD = paper.MethodFigures(
    valid_percent=83.2, points=123, depth_median_m=3.2,
    disparity=DisparityMetrics({1.0: 12.3}, 0.0, 1.0, 2.0, 10), depth=None,
)  # fmt: skip
EXPERIMENT = paper.ExperimentFigures(
    scene="Jadeplant", width_px=640, height_px=480, methods={"corrected": METHOD}, patches={}
)
JOB = JobSummary(
    facts=JobFacts(
        name="drive_06", command="map", source="06", state="failed", tries=2, seconds=12.0,
        worker="tcp", bytes=10, error="no such folder", remark="drift 2.3 (usually 0.5)",
    ),
    figures={}, warnings=(),
)  # fmt: skip
SUMMARIES: dict[str, Summary] = {
    "pair": PAIR,
    "pair without a mesh or a scale": replace(PAIR, faces=0, mesh_coverage=None, up_to_scale=True),
    "disparity": DisparitySummary(disparity=DISPARITY, **COST),
    "disparity of nothing": DisparitySummary(
        disparity=replace(DISPARITY, accuracy=None, disparity_median_px=None, inferred_percent=0.0),
        **COST,
    ),
    "map": MAP,
    "map of which little is known": replace(
        MAP, expected_drift_percent=None, trajectory=None, map=None, fps=None,
        made=replace(MADE, mesh=MeshFigures()),
    ),
    "live": replace(MAP, read=LIVE),
    "merge": JOINED,
    "merge with changes": replace(JOINED, changes={"came": 123, "went": 1}),
    "diff": DiffSummary(
        before="outputs/monday", after="outputs/friday", changes={"came": 123, "went": 1},
        not_compared_ratio={"before": 0.1, "after": 0.2}, objects=(), T_map_world=np.eye(4), **COST,
    ),
    "localize": LOCALIZED,
    "localize in another place": replace(
        LOCALIZED, drive=replace(FOUND, first_fix_frame=None, median_sigma_m=None)
    ),
    "export": EXPORTED,
    "occupancy": replace(EXPORTED, survey=None, products={"grid": GRID}),
    "mesh": replace(EXPORTED, survey=None, products={"mesh": MADE.mesh}),
    "mesh of a cloud": CloudSummary(
        cloud="c.ply", mesh=MeshFigures(faces=3, mesh_coverage=0.9), **COST
    ),
    "export of a pair": CloudSummary(cloud="c.ply", run=OUT, **COST),
    "audit": AUDITED,
    "audit of what cannot be used": replace(
        AUDITED, verdict="not usable", repaired=None, out=None,
        figures=replace(AUDITED.figures, epipolar_error_rms_px=None, depth_error_m=None),
    ),
    "calibrate": CALIBRATED,
    "calibrate again": replace(CALIBRATED, verdict="repeat", files=None),
    "rectify": RECTIFIED,
    "rectify without features": replace(
        RECTIFIED, epipolar_error_px=None, epipolar_error_95_px=None
    ),
    "capture": CAPTURED,
    "board": BoardSummary(
        board="chess:9x6:25mm", square_mm=25.0, measured="squares of 25 mm",
        pattern_width_mm=250.0, pattern_height_mm=175.0,
        paper="a4", paper_width_mm=297.0, paper_height_mm=210.0, file="board.pdf",
    ),
    "evaluate trajectory": TrajectoryEvaluation(
        metrics=PATH, T_truth_estimate=np.eye(4), rotation_deg=0.1, roll="fixed",
        associated="by time", estimate_poses=1101, true_poses=1101, **COST,
    ),
    "evaluate map": MapEvaluation(
        first=ThresholdFigures(metrics=SURFACE), placement=Placement(), beyond_reach=0.12,
        by_threshold=[ThresholdFigures(metrics=SURFACE)] * 5, **COST,
    ),
    "evaluate disparity": DisparityEvaluation(
        pixels=1_234_567, invalid=12.3, sparse=ERRORS, dense=ERRORS,
        confidence={"ece": 0.1, "ause": 0.2},
    ),
    "evaluate occupancy": OccupancyEvaluation(
        metrics=OccupancyMetrics(0.2, 3, VOXELS, VOXELS, CELLS, CELLS)
    ),
    "evaluate middlebury": MiddleburySummary(
        matchers={
            name: {"weighted": {"nonocc": {"dense": {"bad": {"2": 22.3}, "avgerr": 4.56}}}}
            for name in ("sad", "sgm", "fine", "opencv-bm", "opencv-sgbm")
        },
        folder="trainingQ", results={}, mean_over=["ArtL"] * 15, skipped=[], **COST,
    ),
    "paper": paper.PaperSummary(
        as_printed=True, table_1=[], experiments=dict.fromkeys("234", EXPERIMENT), **COST
    ),
    "batch": BatchSummary(
        jobs=[JOB] * 12, succeeded=10, failed=1, not_run=1, bytes=123_456_789,
        jobs_per_hour=12.3, **COST,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SUMMARIES)
def test_a_command_says_in_eight_lines_what_it_made_where_and_what_to_do_next(name, capsys):
    summary = SUMMARIES[name]
    print_summary(summary)
    lines = capsys.readouterr().out.splitlines()
    assert 3 <= len(lines) <= MOST_LINES
    assert lines[-1].split()[0] == "next"
    assert len(lines[-1].split()) > 1
    # A command is to be pasted, and a path cannot be cut: with long folders both may be longer.
    assert max(map(len, lines[:-1])) <= COLUMNS, lines
    folder = getattr(summary, "out", None)
    assert folder is None or any(folder in line for line in lines)


@pytest.mark.parametrize("name", SUMMARIES)
def test_its_json_has_no_number_that_json_has_not_and_verbose_shows_all_of_it(name, capsys):
    summary = SUMMARIES[name]
    print_summary(summary, as_json=True)
    printed = json.loads(capsys.readouterr().out)
    known = json.loads(json.dumps(summary.to_json(), allow_nan=False))
    assert printed == known
    print_summary(summary, verbose=True)
    shown = capsys.readouterr().out
    numbers = [key for key, value in known.items() if isinstance(value, int | float | str)]
    assert all(key in shown for key in numbers if key != "cloud")


def test_warnings_are_on_standard_error_alone(capsys):
    print_summary(replace(MAP, warnings=["too dark"]))
    out, err = capsys.readouterr()
    assert "too dark" not in out
    assert err == "warning: too dark\n"
    print_summary(CALIBRATED)
    assert capsys.readouterr().err == "note: tilt the board more\n"


@dataclass(frozen=True)
class _Part(Figures):
    length_m: float
    bad: dict[float, float]


@dataclass(frozen=True, kw_only=True)
class _Whole(RunSummary):
    origin: str = named("from")
    part: _Part = inline()
    lacking: _Part | None = inline(None)
    parts: dict[str, _Part] = inline_each()
    missing: float | None = optional()
    known: float | None = optional("other")
    nested: _Part
    unknown: float | None
    T: np.ndarray


def test_fields_become_keys_and_parts_may_be_inline_left_out_or_named_otherwise():
    part = _Part(math.inf, {0.5: 1.0, 2.0: math.nan})
    whole = _Whole(
        origin="here", part=part, parts={"a": _Part(1.0, {})}, known=3.0, nested=part, unknown=None,
        T=np.array([[1.0, math.nan]]), warnings=("odd",),
    )  # fmt: skip
    assert whole.to_json() == {
        "from": "here", "length_m": 1.0, "bad": {}, "other": 3.0, "unknown": None,
        "nested": {"length_m": None, "bad": {"0.5": 1.0, "2.0": None}}, "T": [[1.0, None]],
        "warnings": ["odd"],
    }  # fmt: skip
    assert to_json((1, (2.0, math.nan))) == [1, [2.0, None]]
