"""A page is one file that loads nothing, shows text as text, and says all that a run has to say."""

import base64
import gzip
import io
import json
import re
import sys
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from types import SimpleNamespace
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
from PIL import Image
from plotly.offline import get_plotlyjs

from recon.core.values import DisparityMetrics, DisparityTruth, PointCloud, Reason, Trajectory
from recon.evaluation.map import DriveErrors
from recon.odometry.protocol import OdometryHealth
from recon.report.map_page import map_page, write_joined_page
from recon.report.page import command_line, embedded, render_page, write_page
from recon.report.pair_page import pair_page, write_disparity_images, write_pair_page
from recon.report.scene import Points, Scene
from recon.report.sections import Image as Figure
from recon.report.sections import Page, Section, Table, View3D
from recon.report.style import REASON_COLOURS
from recon.report.view3d import plot, view_of
from recon.run.directory import RunDirectory

pytestmark = pytest.mark.usefixtures("blank_figures")

NASTY = "<script>alert('x')</script> & \"quoted\" {{ 1 + 1 }} {% raw %}"
MAX_BYTES = 12e6
LOADING = {"src", "href", "data", "action", "poster", "srcset", "xlink:href"}


class Loads(HTMLParser):
    """Collects what a page would load, its text, and the elements that stay open."""

    VOID: ClassVar = frozenset({"meta", "img", "br", "wbr", "link", "input"})

    def __init__(self, page: str) -> None:
        super().__init__()
        self.loads, self.tags, self.open, self.text = list[str](), list[str](), list[str](), ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loads += [value or "" for name, value in attrs if name in LOADING]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def blocks(page: str) -> dict[str, str]:
    found = re.findall(r'<figure class="block[^>]*>\s*<h3>(.*?)</h3>((?s:.*?))</figure>', page)
    return {unescape(title): inside for title, inside in found}


def key_figures(page: str) -> dict[str, str]:
    found = re.findall(r"<div><dt>(.*?)</dt><dd>(.*?)</dd></div>", page)
    return {unescape(label): unescape(value) for label, value in found}


def rows(block: str) -> list[tuple[str, ...]]:
    body = re.findall(r"<tr>(.*?)</tr>", block.rpartition("<tbody>")[2], re.DOTALL)
    cells = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL) for row in body]
    return [tuple(unescape(cell.replace("<wbr>", "")) for cell in row) for row in cells]


def drive_page(run: SimpleNamespace) -> Page:
    return map_page(run.map_, run.made, run.errors, run.sample, run.rig, run.summary)


def map_html(run: SimpleNamespace) -> str:
    return render_page(drive_page(run))


def pair_html(run: SimpleNamespace) -> str:
    return render_page(pair_page(run))  # type: ignore[arg-type]


def png(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()


BLACK = png(np.zeros((2, 2, 3), np.uint8))


def view(coloured: bool = False, path: str = "path") -> Scene:
    rgb = np.eye(3, dtype=np.uint8) if coloured else None
    cloud = PointCloud(np.eye(3, dtype=np.float32), rgb=rgb)
    return Scene((Points("cloud", cloud),), paths=(Points(path, cloud),))


def some_page(text: str = "plain", found: dict[str, Any] | None = None, **changes: Any) -> Page:
    """A page with a text in every place that can be foreign."""
    table = Table(f"Table {text}", (), [(f"Check {text}", f"Cell {text}")])
    linked = Table(
        "Links", ("job", "state", f"Head {text}"), [(text, "a", "b")], links={text: text}
    )
    content: dict[str, Any] = {
        "title": f"Title {text}",
        "subtitle": f"Subtitle {text}",
        "figures": [(f"Label {text}", f"Figure {text}"), ("Unknown", "")],
        "sections": [
            Section("Empty", [Figure("No figure", None), Table("No row", ("a",), [])]),
            Section(f"Section {text}", [table, linked], f"Intro {text}"),
            Section("Drawn", [Figure(f"Image {text}", BLACK, f"Caption {text}")]),
        ],
        "found": found or {"warnings": [f"Warning {text}"], "verdict": f"Word {text}"},
    }
    return Page(**{**content, **changes})


def some_html(text: str = "plain", **changes: Any) -> str:
    made = (f"recon {text}", f"key: {text}", {f"Package {text}": f"Version {text}"})
    return render_page(some_page(text, **changes), *made)


def scene_page(scene: Scene | None, times: int = 1) -> str:
    """A page with the same view several times."""
    section = Section("S", [View3D("In 3-D", scene, "caption")] * times)
    return render_page(some_page(sections=[section]))


def test_report_loads_nothing_from_outside_and_the_browser_would_refuse_it():
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', some_html())
    assert "default-src 'none'" in policy[1]
    for page in (render_page(some_page()), scene_page(view())):
        links = [target for target in Loads(page).loads if target != "plain"]
        assert all(target.startswith(("data:", "#")) for target in links)
        assert "link" not in Loads(page).tags
        assert not re.search(r"@import|url\(", page)
        assert not re.search(r"https?://", page)


def test_text_cannot_end_a_page_and_every_element_is_closed():
    page, plain = Loads(some_html(NASTY)), Loads(some_html())
    assert (page.open, page.tags) == ([], plain.tags)
    parts = ("Title", "Subtitle", "Label", "Figure", "Section", "Intro", "Table", "Check", "Cell")
    parts += ("Head", "Image", "Caption", "Warning", "Word", "Package", "Version", "recon", "key:")
    for part in parts:
        assert f"{part} {NASTY}" in page.text
        assert f"{part} plain" in plain.text
    assert not any("<" in target or "'" in target for target in page.loads)
    scene = view(path='</script><b>"')
    html = scene_page(scene)
    assert "</script><b>" not in html
    assert Loads(html).open == []
    (packed,) = re.findall(r'<script type="application/json">(.*?)</script>', html)
    assert json.loads(packed) == plot(view_of(scene, 9))


def test_contents_come_first_then_warnings_and_long_names_are_broken():
    page = some_html()
    assert 0 < page.index("Warning plain") < page.index("<dt>Label plain") < page.index("<img")
    assert "Unknown" not in page
    assert "No warnings" in some_html(found={"warnings": ()})
    assert "2 warnings" in some_html(found={"warnings": ("a", "b")})
    assert "1 warning" in some_html(found={"seconds": 1.0}, warnings=["of the page"])
    sections = [("1", "Section plain"), ("2", "Drawn"), ("3", "How it was made")]
    assert re.findall(r'<a href="#section-(\d)">([^<]+)</a>', page) == sections
    assert re.findall(r'<section id="section-(\d)">\s*<h2>([^<]+)', page) == sections
    long = Table("t", (), [("trajectory.ate_max_m", "0.05")])
    page = some_html(sections=[Section("S", [long])])
    assert "trajectory.<wbr>ate_<wbr>max_<wbr>m</th><td>0.05</td>" in page


@pytest.mark.parametrize(
    ("found", "kind"),
    [
        ({"warnings": ()}, "good"),
        ({"warnings": ("w",)}, "warn"),
        ({"warnings": ("w",), "verdict": "usable"}, "warn"),
        ({"warnings": ("w",), "verdict": "good"}, "good"),
    ],
)
def test_only_what_is_wrong_is_alarming(found, kind):
    page = some_html(found=found)
    assert f'class="notice {kind}"' in page
    assert ('role="alert"' in page) == (kind == "warn")


def test_plotly_travels_once_and_colourings_get_a_button_each_where_there_is_a_choice():
    page = scene_page(view(), times=2)
    assert page.count('class="scene"') == 2
    packed = re.findall(r'<script type="text/plain" id="plotly">([^<]*)</script>', page)
    assert len(packed) == 1
    assert gzip.decompress(base64.b64decode(packed[0])).decode() == get_plotlyjs()
    without = some_html()
    assert 'id="plotly"' not in without
    assert len(without) < 20_000
    page = scene_page(view(coloured=True))
    assert re.findall(r"<button[^>]*>(\w+)</button>", page) == ["image", "height"]
    assert "</button>" not in scene_page(view())
    # A scene of nothing is left out, and with it its section.
    assert not re.search("In 3-D|#section-", scene_page(None))


@pytest.mark.parametrize(
    ("program", "line"),
    [
        ("bin/recon", "recon map 'a b'"),
        ("site-packages/recon/__main__.py", "recon map 'a b'"),
        ("other.py", ""),
    ],
)
def test_report_names_the_command_that_made_it_and_no_other_program(program, line, monkeypatch):
    monkeypatch.setattr(sys, "argv", [program, "map", "a b"])
    assert command_line() == line


def test_page_of_a_drive_shows_all_that_the_run_has(drive):
    page = map_html(drive)
    assert {title for title, inside in blocks(page).items() if "<img" in inside} == {
        "Occupancy grid", "Path from above", "Error along the path", "Health of the odometry",
        "Input pair", "Disparity", "Depth", "Why pixels have no disparity", "Confidence",
        "What the calibration does to disparities", "In 3-D",
    }  # fmt: skip
    assert key_figures(page) == {
        "Path": "10.0 m", "Drift (t_rel)": "0.62 %", "Position error (ATE)": "0.410 m",
        "Frames not trusted": "1 of 11", "Mapping rate": "4.2 fps", "Points in the map": "2,000",
    }  # fmt: skip
    shown = blocks(page)
    assert 'class="scene"' in shown["In 3-D"]
    assert rows(shown["Time by stage"]) == [("match", "1.00 s", "100 %")]
    assert "fps: 4.25" in page
    assert "nested:\n  a: [1, null]" in page
    assert ("segments", "3 of 5 m") in rows(shown["Path against truth"])
    assert "Stereo, frame 7" in page
    assert 1e5 < len(page.encode()) < MAX_BYTES


def test_page_of_a_pair_shows_all_that_the_run_has(view):
    page = pair_html(view)
    shown = blocks(page)
    assert {"Input pair", "Disparity", "Disparity error", "In 3-D"} <= shown.keys()
    assert ("pixels compared", "1,440") in rows(shown["Disparity against truth"])
    figures = key_figures(page)
    assert figures["Pixels measured"] == "75.0 %"
    assert (figures["Bad 2: off by more than 2 px"], figures["Points"]) == ("10.0 %", "2,000")
    assert len(page.encode()) < MAX_BYTES
    assert "baseline 0.5 m" in page
    view.summary["up_to_scale"] = True
    assert "every m in this report is one baseline" in pair_html(view)


def test_page_of_a_pair_tells_what_was_inferred_from_what_was_measured(view, both):
    assert "inferred" not in key_figures(pair_html(view))
    view.disparity = both
    metrics = DisparityMetrics({2.0: 5.0}, 0.0, 0.5, 0.5, 360)
    view.by_kind = {"measured": metrics, "inferred": replace(metrics, bad={2.0: 81.0})}
    page = pair_html(view)
    figures, errors = key_figures(page), rows(blocks(page)["Disparity against truth"])
    assert (figures["Pixels measured"], figures["Pixels inferred"]) == ("25.0 %", "50.0 %")
    assert ("bad 2: off by more than 2 px", "10.00 %", "5.00 %", "81.00 %") in errors
    assert "Measured and inferred: of such pixels alone" in page
    assert "50.0 % inferred from planes around them (hatched)" in page
    assert "Of measured pixels alone: --set cloud.inferred=true" in page
    view.summary["inferred_points"] = 1000
    assert "1,000 of the points are inferred" in pair_html(view)


def test_a_picture_that_is_too_long_for_its_format_is_shown_smaller():
    buffer = io.BytesIO()
    Image.new("RGB", (40, 20_000)).save(buffer, "PNG")
    ((_, url),) = embedded(buffer.getvalue())["layers"]
    with Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))) as image:
        assert max(image.size) == 16_383


def test_colour_images_of_a_pair_are_of_what_was_measured(view, both, tmp_path):
    view.disparity = both
    with RunDirectory(tmp_path / "pair") as directory:
        write_disparity_images(view, directory)
        directory.write_json("run.json", {})
    for name in ("disparity", "confidence"):
        image = cv2.imread(str(tmp_path / f"pair/disparity/{name}_colour.png"))
        np.testing.assert_array_equal((image < 40).all(axis=2), ~both.measured)
    reasons = cv2.imread(str(tmp_path / "pair/disparity/reason_colour.png"))[:, :, ::-1]
    np.testing.assert_array_equal(reasons[0, -1], REASON_COLOURS[Reason.FILLED])


def test_the_rig_is_tabulated_where_it_was_fitted(drive):
    page = map_html(drive)
    shown = blocks(page)
    assert "The motion shows another rig" in page
    assert ("depth at 30 m", "infinite", "–") in rows(shown["With the rig as given"])
    assert "By the motion of 12 windows" in shown["With the rig as given"]
    assert rows(shown["Right camera"])[1:] == [
        ("yaw", "-0.5000°", "0.1°", "1°"), ("roll", "+0.0000°", "0.1°", "1°"),
        ("focal length", "-1.0000 %", "0.2 %", "2 %"),
    ]  # fmt: skip
    assert rows(shown["Lenses"])[0] == ("k1", "-1.00 ± 0.10", "+0.00 ± 0.10")
    drive.rig = replace(drive.rig, calibration=drive.rig.given)
    assert "recon map uses the rig as calibrated" in map_html(drive)
    drive.rig.fitted.covariance[4:] = 0.0  # lenses that cannot be corrected
    assert "Lenses" not in blocks(map_html(drive))
    drive.rig = replace(drive.rig, fitted=None)
    assert "Right camera" not in map_html(drive)


@pytest.mark.parametrize(("ate_m", "text"), [(0.0019, "0.00190 m"), (1234.5, "1234 m")])
def test_a_position_error_is_shown_in_digits_that_fit_it(drive, ate_m, text):
    drive.errors = replace(drive.errors, path=replace(drive.errors.path, ate_m=ate_m))
    page = map_html(drive)
    assert key_figures(page)["Position error (ATE)"] == text
    assert ("absolute trajectory error (ATE)", text) in rows(blocks(page)["Path against truth"])


def test_loops_that_were_closed_and_that_were_not_are_in_the_report(drive):
    session, figures = drive.map_.first, {"found": 3, "keyframes": 11, "largest_correction_m": 2.5}
    session.loops = {"closed": [{"first": 0, "last": 9}]}
    drive.summary["loops"] = {**figures, "closed": 1}
    page = map_html(drive)
    assert key_figures(page)["Loops closed, path moved by"] == "1 of 3, 2.50 m"
    assert "1 loop closed, with 11 keyframes" in blocks(page)["Loops"]
    session.loops = {"closed": []}
    drive.summary["loops"] = {**figures, "closed": 0, "largest_correction_m": 0.0}
    page = map_html(drive)
    assert key_figures(page)["Loops closed, path moved by"] == "0 of 3, 0 m"
    assert "Loops" not in blocks(page)


def test_a_map_compared_with_the_truth_is_tabulated(drive):
    cells = {"precision": 0.75, "recall": 0.5, "iou_occupied": None, "iou_free": 0.25}
    part = cells | {"occupied_called_free": 0.125}
    kinds = ("voxels", "grid", "voxels_exact", "grid_exact")
    found = {**dict.fromkeys(kinds, part), "least_frames": 3, "resolution_m": 0.2}
    drive.summary["occupancy"] = found
    table = blocks(map_html(drive))["Occupancy against truth"]
    assert "at least 3 frames saw, in cells of 0.2 m" in table
    assert rows(table)[0] == ("occupied voxels, precision", "0.750", "0.750")
    assert rows(table)[2][1:] == ("–", "–")


def test_notes_of_the_odometry_and_paths_in_the_axes_of_the_cloud_are_shown(drive):
    scene = drive_page(drive).sections[0].blocks[0].scene
    assert [trace["name"] for trace in plot(view_of(scene, 9))["data"]][-2:] == [
        "path",
        "true path",
    ]
    low, high = plot(view_of(scene, 9))["layout"]["scene"]["xaxis"]["range"]
    # Both run from 0 to 10 m forward in map axes.
    assert low == pytest.approx(0.0, abs=0.3)
    assert high == pytest.approx(10.0, abs=0.3)
    assert rows(blocks(map_html(drive))["Notes of the odometry"]) == [("5", "too few <tracks>")]
    poses = np.tile(np.eye(4), (23, 1, 1))
    session = drive.map_.first
    session.trajectory = session.odometry = Trajectory(poses, np.arange(23.0))
    session.health = [OdometryHealth(ok=False)] * 23
    notes = blocks(map_html(drive))["Notes of the odometry"]
    assert len(rows(notes)) == 20
    assert "The first 20 of 23." in notes


def test_page_of_a_drive_with_nothing_but_path_and_grid_is_made(drive):
    drive.errors, drive.made.cloud, drive.made.mesh = DriveErrors(None, None, None), None, None
    drive.summary, drive.map_.first.health = {"source": "drive", "warnings": []}, ()
    page = map_html(drive)
    assert "Path from above" in blocks(page)
    assert not {"In 3-D", "Notes of the odometry"} & blocks(page).keys()


def test_page_of_a_pair_with_truth_of_another_size_or_without_any_disparity_is_made(
    view, nothing_found
):
    half = view.disparity.values[::2, ::2].copy()
    view.truth = DisparityTruth(half, np.isfinite(half))
    assert "Disparity error" not in blocks(pair_html(view))
    view.disparity, view.cloud = nothing_found, PointCloud(np.zeros((0, 3), dtype=np.float32))
    view.truth = view.metrics = None
    page = pair_html(view)
    assert key_figures(page)["Pixels measured"] == "0.0 %"
    assert "Against the truth" not in page
    assert "In 3-D" not in page


def test_runs_leave_their_pages_and_images(drive, view, tmp_path):
    for name, write in (
        ("drive", lambda run: write_page(drive_page(drive), run)),
        ("pair", lambda run: write_pair_page(view, run)),
    ):
        with RunDirectory(tmp_path / name) as directory:
            directory.path("config.yaml").write_text("rectification: <b>\n")
            write(directory)
            directory.write_json("run.json", {})
    page = (tmp_path / "drive/report.html").read_text(encoding="utf-8")
    assert re.search("Map of drive &lt;1&gt;(?s:.*)frame 5: lost(?s:.*)Versions", page)
    assert "<pre>rectification: &lt;b&gt;\n</pre>" in page
    page = (tmp_path / "pair/report.html").read_text(encoding="utf-8")
    assert re.search("Stereo pair im0.png(?s:.*)a warning", page)
    folder = tmp_path / "pair/disparity"
    names = {"disparity_colour.png", "confidence_colour.png", "reason_colour.png"}
    assert {path.name for path in folder.iterdir()} == names
    reasons = cv2.imread(str(folder / "reason_colour.png"))[:, :, ::-1]
    np.testing.assert_array_equal(reasons[0, 0], REASON_COLOURS[Reason.BORDER])


def test_drives_of_a_merged_map_are_named_in_its_page(drive, trajectory, tmp_path):
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
