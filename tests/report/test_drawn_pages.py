"""The pages of a drive and of a pair show all that a run has, and are not too large."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np

from recon.core.values import Reason
from recon.report.colour import REASON_COLOURS
from recon.report.pair_page import write_disparity_images
from recon.run.directory import RunDirectory
from tests.report.pages import blocks, images, key_figures, map_html, pair_html, rows

MAX_BYTES = 12e6


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
    assert ("fps", "4.25 frames/s") in table
    assert ("segments", "3 of 5 m") in rows(shown["Path against truth"])
    assert "frame 5: lost" in page
    assert "drive &lt;1&gt;" in page
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
