"""The pages of a drive and of a pair show all that a run has."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    OccupancyGrid,
    PointCloud,
    Reason,
    RectifiedPair,
    Trajectory,
    TrajectoryMetrics,
    TriangleMesh,
)
from recon.core.values.arrays import Float64
from recon.map.drive.drive_loops import DriveLoops
from recon.odometry.protocol import OdometryHealth
from recon.places.graph import Closure
from recon.places.verify import Loop
from recon.report.colour import REASON_COLOURS
from recon.report.map_page import map_content, write_map_page
from recon.report.page import render_page
from recon.report.pair_page import pair_content, write_disparity_images, write_pair_page
from recon.run.directory import RunDirectory
from tests.report.pages import blocks, images, key_figures, rows

MAX_BYTES = 12e6
METRICS = TrajectoryMetrics(0.62, 0.7, 0.41, 0.01, 0.03, 10.0, 11, (5.0,), 3)


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
) -> SimpleNamespace:
    """A `MapRun` with everything but loops."""
    mapped = SimpleNamespace(
        trajectory=trajectory,
        T_map_world=T_map_world,
        health=health,
        sample=SimpleNamespace(pair=pair, disparity=disparity),
        loops=None,
    )
    return SimpleNamespace(
        name="drives/drive <1>",
        mapped=mapped,
        cloud=cloud,
        grid=grid,
        mesh=mesh,
        truth=SimpleNamespace(trajectory=trajectory),
        metrics=METRICS,
        summary={"fps": 4.25, "points": 2000, "stages": {"match": 1.0}, "nested": {"a": [1, None]}},
        warnings=("frame 5: lost",),
    )


def map_html(run: SimpleNamespace) -> str:
    return render_page("map", **map_content(run))  # type: ignore[arg-type]


def pair_html(run: SimpleNamespace) -> str:
    return render_page("pair", **pair_content(run))  # type: ignore[arg-type]


def test_page_of_a_drive_shows_all_that_the_run_has(drive: SimpleNamespace) -> None:
    page = map_html(drive)
    assert images(page) == {
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
    shown = blocks(page)
    assert '<div class="scene">' in shown["In 3-D"]
    table = rows(shown["All figures"])
    assert ("nested.a", "1, –") in table
    assert ("fps", "4.25") in table
    assert ("segments", "3 of 5 m") in rows(shown["Path against truth"])
    assert "frame 5: lost" in page
    assert "drive &lt;1&gt;" in page
    assert "Stereo, frame 7" in page


def test_page_of_a_drive_puts_the_main_figures_first(drive: SimpleNamespace) -> None:
    figures = key_figures(map_html(drive))
    assert figures["Path"] == "10.0 m"
    assert figures["Drift (t_rel)"] == "0.62 %"
    assert figures["Frames not trusted"] == "1 of 11"
    assert figures["Mapping rate"] == "4.2 fps"
    assert figures["Points in the map"] == "2,000"
    assert "Triangles" not in figures


def test_loops_that_were_closed_and_that_were_not_are_in_the_report(
    drive: SimpleNamespace, trajectory: Trajectory
) -> None:
    moved = np.array(trajectory.T_world_camera)
    moved[:, 0, 3] += np.linspace(0.0, 2.5, len(moved))
    bent = Trajectory(moved, trajectory.timestamps_s)
    right, wrong = (Loop(0, last, np.eye(4), np.eye(6), 50, 0.9) for last in (9, 10))
    drive.mapped.loops = DriveLoops(trajectory, Closure(bent, (right,), (wrong,)), 11, 3, {})
    page = map_html(drive)
    assert key_figures(page)["Loops closed, path moved by"] == "1 of 3, 2.50 m"
    assert "1 loops were closed, with 11 keyframes" in blocks(page)["Loops"]
    drive.mapped.loops = DriveLoops(trajectory, Closure(trajectory, (), (wrong,)), 11, 3, {})
    page = map_html(drive)
    assert key_figures(page)["Loops closed, path moved by"] == "0 of 3, 0.00 m"
    assert "Loops" not in blocks(page)


def test_notes_of_the_odometry_are_listed_by_frame(drive: SimpleNamespace) -> None:
    assert rows(blocks(map_html(drive))["Notes of the odometry"]) == [("5", "too few <tracks>")]
    drive.mapped.health = [OdometryHealth(ok=False)] * 23
    notes = blocks(map_html(drive))["Notes of the odometry"]
    assert len(rows(notes)) == 20
    assert "The first 20 of 23." in notes


def test_a_map_compared_with_the_truth_is_tabulated(drive: SimpleNamespace) -> None:
    cells = {"precision": 0.75, "recall": 0.5, "iou_occupied": None, "iou_free": 0.25}
    part = cells | {"occupied_called_free": 0.125}
    kinds = ("voxels", "grid", "voxels_exact", "grid_exact")
    found = {**dict.fromkeys(kinds, part), "least_frames": 3, "resolution_m": 0.2}
    drive.summary["occupancy"] = found
    table = blocks(map_html(drive))["Occupancy against truth"]
    assert "at least 3 frames saw, in cells of 0.2 m" in table
    assert rows(table)[0] == ("occupied voxels, precision", "0.750", "0.750")
    assert rows(table)[2][1:] == ("–", "–")


def test_paths_and_cloud_are_drawn_in_the_same_axes(drive: SimpleNamespace) -> None:
    plot: dict[str, Any] = map_content(drive)["view"]  # type: ignore[arg-type]
    assert [trace["name"] for trace in plot["data"]][-2:] == ["path", "true path"]
    low, high = plot["layout"]["scene"]["xaxis"]["range"]
    # Both run from 0 to 10 m forward in map axes.
    assert low == pytest.approx(0.0, abs=0.3)
    assert high == pytest.approx(10.0, abs=0.3)


def test_page_of_a_drive_with_nothing_but_a_path_is_made(drive: SimpleNamespace) -> None:
    drive.truth = drive.metrics = drive.cloud = drive.mesh = drive.grid = None
    drive.summary, drive.mapped.health = {}, ()
    page = map_html(drive)
    assert "Path from above" in blocks(page)
    assert not {"In 3-D", "Occupancy grid", "Notes of the odometry"} & blocks(page).keys()


def test_page_of_a_drive_is_of_bounded_size(drive: SimpleNamespace) -> None:
    assert 1e5 < len(map_html(drive).encode()) < MAX_BYTES


def test_drive_leaves_its_page(drive: SimpleNamespace, tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "run") as directory:
        write_map_page(drive, directory)  # type: ignore[arg-type]
        directory.write_json("run.json", {})
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "Map of drive &lt;1&gt;" in page
    assert "Versions" in page


@pytest.fixture
def view(pair: RectifiedPair, disparity: Disparity, cloud: PointCloud) -> SimpleNamespace:
    """A `PairRun`."""
    return SimpleNamespace(
        name="scenes/bike/im0.png",
        pair=pair,
        disparity=disparity,
        cloud=cloud,
        mesh=None,
        truth=DisparityTruth(disparity.values + 1, disparity.valid),
        metrics=DisparityMetrics({2.0: 10.0}, 25.0, 1.0, 1.0, 1440),
        summary={"points": 2000},
        warnings=("a warning",),
    )


def test_page_of_a_pair_shows_all_that_the_run_has(view: SimpleNamespace) -> None:
    page = pair_html(view)
    shown = blocks(page)
    assert {"Input pair", "Disparity", "Disparity error", "In 3-D"} <= shown.keys()
    assert ("pixels compared", "1,440") in rows(shown["Disparity against truth"])
    figures = key_figures(page)
    assert figures["Pixels with a disparity"] == "75.0 %"
    assert figures["Off by more than 2 px"] == "10.0 %"
    assert figures["Points"] == "2,000"
    assert len(page.encode()) < MAX_BYTES


def test_page_of_a_pair_without_any_disparity_is_made(
    view: SimpleNamespace, nothing_found: Disparity
) -> None:
    view.disparity, view.cloud = nothing_found, PointCloud(np.zeros((0, 3), dtype=np.float32))
    view.truth = view.metrics = None
    page = pair_html(view)
    assert key_figures(page)["Pixels with a disparity"] == "0.0 %"
    assert "Against the truth" not in page
    assert "In 3-D" not in page


def test_page_of_a_pair_up_to_scale_says_so(view: SimpleNamespace) -> None:
    assert "baseline 0.5 m" in pair_html(view)
    view.summary["up_to_scale"] = True
    assert "every m in this report is one baseline" in pair_html(view)


def test_truth_of_another_size_gives_no_error_map(view: SimpleNamespace) -> None:
    half = view.disparity.values[::2, ::2].copy()
    view.truth = DisparityTruth(half, np.isfinite(half))
    assert "Disparity error" not in blocks(pair_html(view))


def test_pair_leaves_its_page_and_images_in_colour(view: SimpleNamespace, tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "run") as directory:
        write_pair_page(view, directory)  # type: ignore[arg-type]
        directory.write_json("run.json", {})
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "Stereo pair im0.png" in page
    assert "a warning" in page
    assert (tmp_path / "run" / "disparity" / "disparity_colour.png").is_file()


def test_disparity_leaves_images_in_colour_alone(view: SimpleNamespace, tmp_path: Path) -> None:
    with RunDirectory(tmp_path / "run") as directory:
        write_disparity_images(view, directory)  # type: ignore[arg-type]
        directory.write_json("run.json", {})
    folder = tmp_path / "run" / "disparity"
    names = {"disparity_colour.png", "confidence_colour.png", "reason_colour.png"}
    assert {path.name for path in folder.iterdir()} == names
    assert not (tmp_path / "run" / "report.html").exists()
    reasons = cv2.imread(str(folder / "reason_colour.png"))[:, :, ::-1]
    np.testing.assert_array_equal(reasons[0, 0], REASON_COLOURS[Reason.BORDER])
