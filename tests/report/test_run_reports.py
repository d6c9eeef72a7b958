from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    OccupancyGrid,
    PointCloud,
    RectifiedPair,
    Trajectory,
    TrajectoryMetrics,
    TriangleMesh,
)
from recon.core.values.arrays import Float64
from recon.map.drive_loops import DriveLoops
from recon.odometry.protocol import OdometryHealth
from recon.places.graph import Closure
from recon.places.verify import Loop
from recon.report.blocks import run_blocks
from recon.report.html import FigureBlock, ReportContent, SceneBlock, TableBlock, render_html
from recon.report.map_report import MapReportInputs, map_report
from recon.report.pair_report import PairReportInputs, pair_report

MAX_BYTES = 12e6
METRICS = TrajectoryMetrics(0.62, 0.7, 0.41, 0.01, 0.03, 10.0, 11, (5.0,), 3)


def blocks(content: ReportContent) -> dict[str, object]:
    return {block.title: block for section in content.sections for block in section.blocks}


@pytest.fixture
def drive(
    pair: RectifiedPair,
    disparity: Disparity,
    trajectory: Trajectory,
    T_map_world: Float64,
    health: list[OdometryHealth],
    grid: OccupancyGrid,
    cloud: PointCloud,
    mesh: TriangleMesh,
) -> MapReportInputs:
    return MapReportInputs(
        source="drive <1>",
        trajectory=trajectory,
        T_map_world=T_map_world,
        samples=((pair, disparity),),
        health=health,
        truth=trajectory,
        metrics=METRICS,
        grid=grid,
        cloud=cloud,
        mesh=mesh,
        summary={"fps": 4.25, "points": 2000, "stages": {"match": 1.0}, "nested": {"a": [1, None]}},
        warnings=("frame 5: lost",),
        config="matching: {}",
        versions={"recon": "0"},
    )


def test_report_of_a_drive_shows_all_that_the_run_has(drive: MapReportInputs) -> None:
    shown = blocks(map_report(drive))
    figures = {title for title, block in shown.items() if isinstance(block, FigureBlock)}
    assert figures == {
        "Occupancy grid",
        "Path from above",
        "Error along the path",
        "Health of the odometry",
        "Input pair",
        "Disparity",
        "Depth",
        "Why pixels have no disparity",
        "Confidence",
        "Time by stage",
    }
    assert isinstance(shown["In 3-D"], SceneBlock)
    table = shown["All figures"]
    assert isinstance(table, TableBlock)
    assert ("nested.a", "1, –") in table.rows
    assert ("fps", "4.25") in table.rows


def test_report_of_a_drive_puts_the_main_figures_first(drive: MapReportInputs) -> None:
    figures = dict(map_report(drive).figures)
    assert figures["Path"] == "10.0 m"
    assert figures["Drift (t_rel)"] == "0.62 %"
    assert figures["Frames not trusted"] == "1 of 11"
    assert figures["Mapping rate"] == "4.2 fps"
    assert figures["Points in the map"] == "2,000"


def test_loops_that_were_closed_and_that_were_not_are_in_the_report(
    drive: MapReportInputs, trajectory: Trajectory
) -> None:
    moved = np.array(trajectory.T_world_camera)
    moved[:, 0, 3] += np.linspace(0.0, 2.5, len(moved))
    bent = replace(trajectory, T_world_camera=moved)
    right, wrong = (Loop(0, last, np.eye(4), np.eye(6), 50, 0.9) for last in (9, 10))
    loops = DriveLoops(trajectory, Closure(bent, (right,), (wrong,)), 11, 3, {})
    report = map_report(replace(drive, loops=loops))
    assert dict(report.figures)["Loops closed, path moved by"] == "1 of 3, 2.50 m"
    assert isinstance(blocks(report)["Loops"], FigureBlock)
    unclosed = DriveLoops(trajectory, Closure(trajectory, (), (wrong,)), 11, 3, {})
    report = map_report(replace(drive, loops=unclosed))
    assert dict(report.figures)["Loops closed, path moved by"] == "0 of 3, 0.00 m"
    assert "Loops" not in blocks(report)


def test_notes_of_the_odometry_are_listed_by_frame(drive: MapReportInputs) -> None:
    notes = blocks(map_report(drive))["Notes of the odometry"]
    assert isinstance(notes, TableBlock)
    assert list(notes.rows) == [("5", "too few <tracks>")]


def test_paths_and_cloud_are_drawn_in_the_same_axes(drive: MapReportInputs) -> None:
    scene = blocks(map_report(drive))["In 3-D"]
    assert isinstance(scene, SceneBlock)
    names = [trace["name"] for trace in scene.scene["data"]]
    assert names[-2:] == ["path", "true path"]
    low, high = scene.scene["layout"]["scene"]["xaxis"]["range"]
    # Both run from 0 to 10 m forward in map axes.
    assert low == pytest.approx(0.0, abs=0.3)
    assert high == pytest.approx(10.0, abs=0.3)


def test_report_of_a_drive_with_nothing_but_a_path_is_made(
    trajectory: Trajectory, T_map_world: Float64
) -> None:
    page = render_html(map_report(MapReportInputs("bare", trajectory, T_map_world)))
    assert "Path from above" in page
    assert "In 3-D" not in page


def test_report_of_a_drive_is_of_bounded_size(drive: MapReportInputs) -> None:
    page = render_html(map_report(drive))
    assert 1e5 < len(page.encode()) < MAX_BYTES
    assert "drive &lt;1&gt;" in page


@pytest.fixture
def view(pair: RectifiedPair, disparity: Disparity, cloud: PointCloud) -> PairReportInputs:
    truth = DisparityTruth(disparity.values + 1, disparity.valid)
    metrics = DisparityMetrics({2.0: 10.0}, 25.0, 1.0, 1.0, 1440)
    return PairReportInputs("bike", pair, disparity, truth, metrics, cloud)


def test_report_of_a_pair_shows_all_that_the_run_has(view: PairReportInputs) -> None:
    content = pair_report(view)
    shown = blocks(content)
    assert {"Input pair", "Disparity", "Disparity error", "In 3-D"} <= shown.keys()
    figures = dict(content.figures)
    assert figures["Pixels with a disparity"] == "75.0 %"
    assert figures["Off by more than 2 px"] == "10.0 %"
    assert len(render_html(content).encode()) < MAX_BYTES


def test_report_of_a_pair_without_any_disparity_is_made(
    pair: RectifiedPair, nothing_found: Disparity
) -> None:
    empty = PointCloud(np.zeros((0, 3), dtype=np.float32))
    page = render_html(pair_report(PairReportInputs("fog", pair, nothing_found, cloud=empty)))
    assert "0.0 %" in page
    assert "Against the truth" not in page


def test_truth_of_another_size_gives_no_error_map(
    view: PairReportInputs, pair: RectifiedPair, disparity: Disparity
) -> None:
    half = disparity.values[::2, ::2].copy()
    truth = DisparityTruth(half, np.isfinite(half))
    assert "Disparity error" not in blocks(
        pair_report(PairReportInputs("x", pair, disparity, truth))
    )


def test_figures_of_each_part_are_rows_of_their_own() -> None:
    (table,) = run_blocks({"by_length": [{"length_m": 50.0, "segments": 15}], "views_dropped": []})
    assert isinstance(table, TableBlock)
    assert list(table.rows) == [
        ("by_length.0.length_m", "50"),
        ("by_length.0.segments", "15"),
        ("views_dropped", "none"),
    ]
