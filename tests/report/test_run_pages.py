"""The pages of a drive and of a pair say all that a run has to say."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from recon.core.values import (
    Disparity,
    DisparityTruth,
    PointCloud,
    Reason,
    Trajectory,
)
from recon.evaluation.map_comparison import DriveErrors
from recon.odometry.protocol import OdometryHealth
from recon.report.map_page import map_content, write_joined_page, write_map_page
from recon.report.pair_page import write_pair_page
from recon.report.style import REASON_COLOURS
from recon.run.directory import RunDirectory
from tests.report.pages import blocks, images, key_figures, map_html, pair_html, rows

pytestmark = pytest.mark.usefixtures("blank_figures")


MAX_BYTES = 12e6


def test_page_of_a_drive_shows_all_that_the_run_has(drive: SimpleNamespace) -> None:
    page = map_html(drive)
    assert images(page) == {
        "Occupancy grid", "Path from above", "Error along the path", "Health of the odometry",
        "Input pair", "Disparity", "Depth", "Why pixels have no disparity", "Confidence",
        "Time by stage",
    }  # fmt: skip
    assert key_figures(page) == {
        "Path": "10.0 m", "Drift (t_rel)": "0.62 %", "Position error (ATE)": "0.41 m",
        "Frames not trusted": "1 of 11", "Mapping rate": "4.2 fps", "Points in the map": "2,000",
    }  # fmt: skip
    shown = blocks(page)
    assert '<div class="scene">' in shown["In 3-D"]
    table = rows(shown["All figures"])
    assert {("nested.a", "1, –"), ("fps", "4.25 frames/s")} <= set(table)
    assert ("segments", "3 of 5 m") in rows(shown["Path against truth"])
    assert "Stereo, frame 7" in page
    assert 1e5 < len(page.encode()) < MAX_BYTES


def test_page_of_a_pair_shows_all_that_the_run_has(view: SimpleNamespace) -> None:
    page = pair_html(view)
    shown = blocks(page)
    assert {"Input pair", "Disparity", "Disparity error", "In 3-D"} <= shown.keys()
    assert ("pixels compared", "1,440") in rows(shown["Disparity against truth"])
    figures = key_figures(page)
    assert figures["Pixels with a disparity"] == "75.0 %"
    assert figures["Bad 2: off by more than 2 px"] == "10.0 %"
    assert figures["Points"] == "2,000"
    assert len(page.encode()) < MAX_BYTES
    assert "baseline 0.5 m" in page
    view.summary["up_to_scale"] = True
    assert "every m in this report is one baseline" in pair_html(view)


def test_loops_that_were_closed_and_that_were_not_are_in_the_report(
    drive: SimpleNamespace,
) -> None:
    session, figures = drive.map_.first, {"found": 3, "keyframes": 11, "largest_correction_m": 2.5}
    session.loops = {"closed": [{"first": 0, "last": 9}]}
    drive.summary["loops"] = {**figures, "closed": 1}
    page = map_html(drive)
    assert key_figures(page)["Loops closed, path moved by"] == "1 of 3, 2.50 m"
    assert "1 loop closed, with 11 keyframes" in blocks(page)["Loops"]
    session.loops = {"closed": []}
    drive.summary["loops"] = {**figures, "closed": 0, "largest_correction_m": 0.0}
    page = map_html(drive)
    assert key_figures(page)["Loops closed, path moved by"] == "0 of 3, 0.00 m"
    assert "Loops" not in blocks(page)


def test_notes_of_the_odometry_are_listed_by_frame(drive: SimpleNamespace) -> None:
    assert rows(blocks(map_html(drive))["Notes of the odometry"]) == [("5", "too few <tracks>")]
    poses = np.tile(np.eye(4), (23, 1, 1))
    drive.map_.first.trajectory = Trajectory(poses, np.arange(23.0))
    drive.map_.first.health = [OdometryHealth(ok=False)] * 23
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
    plot: dict[str, Any] = map_content(drive.map_, drive.made, drive.errors, drive.sample)["view"]
    assert [trace["name"] for trace in plot["data"]][-2:] == ["path", "true path"]
    low, high = plot["layout"]["scene"]["xaxis"]["range"]
    # Both run from 0 to 10 m forward in map axes.
    assert low == pytest.approx(0.0, abs=0.3)
    assert high == pytest.approx(10.0, abs=0.3)


def test_page_of_a_drive_with_nothing_but_path_and_grid_is_made(drive: SimpleNamespace) -> None:
    drive.errors, drive.made.cloud, drive.made.mesh = DriveErrors(None, None, None), None, None
    drive.summary, drive.map_.first.health = {"source": "drive", "warnings": []}, ()
    page = map_html(drive)
    assert "Path from above" in blocks(page)
    assert not {"In 3-D", "Notes of the odometry"} & blocks(page).keys()


def test_page_of_a_pair_without_any_disparity_is_made(
    view: SimpleNamespace, nothing_found: Disparity
) -> None:
    view.disparity, view.cloud = nothing_found, PointCloud(np.zeros((0, 3), dtype=np.float32))
    view.truth = view.metrics = None
    page = pair_html(view)
    assert key_figures(page)["Pixels with a disparity"] == "0.0 %"
    assert "Against the truth" not in page
    assert "In 3-D" not in page


def test_truth_of_another_size_gives_no_error_map(view: SimpleNamespace) -> None:
    half = view.disparity.values[::2, ::2].copy()
    view.truth = DisparityTruth(half, np.isfinite(half))
    assert "Disparity error" not in blocks(pair_html(view))


def test_runs_leave_their_pages_and_images(
    drive: SimpleNamespace, view: SimpleNamespace, tmp_path: Path
) -> None:
    for name, write in (
        ("drive", lambda run: write_map_page(**vars(drive), run=run)),
        ("pair", lambda run: write_pair_page(view, run)),
    ):
        with RunDirectory(tmp_path / name) as directory:
            write(directory)
            directory.write_json("run.json", {})
    page = (tmp_path / "drive/report.html").read_text(encoding="utf-8")
    assert re.search("Map of drive &lt;1&gt;(?s:.*)frame 5: lost(?s:.*)Versions", page)
    page = (tmp_path / "pair/report.html").read_text(encoding="utf-8")
    assert re.search("Stereo pair im0.png(?s:.*)a warning", page)
    folder = tmp_path / "pair/disparity"
    names = {"disparity_colour.png", "confidence_colour.png", "reason_colour.png"}
    assert {path.name for path in folder.iterdir()} == names
    reasons = cv2.imread(str(folder / "reason_colour.png"))[:, :, ::-1]
    np.testing.assert_array_equal(reasons[0, 0], REASON_COLOURS[Reason.BORDER])


def test_drives_of_a_merged_map_are_named_in_its_page(
    drive: SimpleNamespace, trajectory: Trajectory, tmp_path: Path
) -> None:
    drive.map_.paths = {0: trajectory, 2: trajectory}
    sessions = [
        {"number": n, "name": f"drive {n}", "frames": 11, "frames_placed": 10, "length_m": 10.0,
         "positions": 0, "linked": n != 1}
        for n in range(3)
    ]  # fmt: skip
    summary = drive.summary | {"frames": 22, "path_length_m": 20.0, "sessions": sessions}
    summary |= {"links": {"count": 4, "refused": 1, "pairs": {"0-2": 4}}, "points_removed": 3}
    summary |= {"positions_misfit_rms_m": None, "seconds": 1.0, "peak_memory_mb": 9.0}
    with RunDirectory(tmp_path / "run") as directory:
        write_joined_page(drive.map_, drive.made, summary, directory)
        directory.write_json("run.json", {})
    page = (tmp_path / "run/report.html").read_text(encoding="utf-8")
    assert "Map of 3 drives" in page
    assert key_figures(page)["Drives in the map"] == "2 of 3"
    assert rows(blocks(page)["Sessions"])[1] == ("1", "drive 1", "11", "10", "10.0", "0", "no")
    assert "1 more contradict" in blocks(page)["Places that two drives saw"]
    assert "session 2" in blocks(page)["In 3-D"]
