"""`recon evaluate middlebury` and `recon evaluate disparity` from files to figures."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from recon.io.images.disparity import write_disparity_png, write_pfm
from recon.io.images.image import read_image
from tests.hostile import refusals

HEIGHT, WIDTH, NEAR, FAR = 48, 96, 12, 4
MATCHERS = "sad,opencv-bm,opencv-sgbm"
Run = tuple[dict[str, Any], Path, str]


def noise(seed: int, shape: tuple[int, int]) -> np.ndarray:
    image = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    return cv2.GaussianBlur(image, (3, 3), 0)


def write_scene(folder: Path, scale: int = 1, *, truth: bool = True) -> None:
    """A square in front of a wall, in MiddEval3's layout, at 1 or 2 times the smallest size."""
    folder.mkdir(parents=True)
    height, width = scale * HEIGHT, scale * WIDTH
    wall, square = noise(1, (height, 2 * width)), noise(2, (height, width))
    disparity = np.full((height, width), FAR * scale, np.float32)
    inside = np.s_[12 * scale : 36 * scale, 40 * scale : 70 * scale]
    disparity[inside] = NEAR * scale
    left = wall[:, :width].copy()
    left[inside] = square[inside]
    right = wall[:, FAR * scale : FAR * scale + width].copy()
    near = NEAR * scale
    right[:, : width - near][:, 40 * scale - near : 70 * scale - near][12 * scale : 36 * scale] = (
        square[inside]
    )
    nonocc = np.full((height, width), 255, np.uint8)
    nonocc[12 * scale : 36 * scale, (40 - NEAR + FAR) * scale : 40 * scale] = 128
    nonocc[:, : FAR * scale] = 128
    cv2.imwrite(str(folder / "im0.png"), left)
    cv2.imwrite(str(folder / "im1.png"), right)
    cv2.imwrite(str(folder / "mask0nocc.png"), nonocc)
    if truth:
        write_pfm(folder / "disp0GT.pfm", disparity)
    f, cx = 100 * scale, 40 * scale
    (folder / "calib.txt").write_text(
        f"cam0=[{f} 0 {cx}; 0 {f} 20; 0 0 1]\ncam1=[{f} 0 {cx + scale}; 0 {f} 20; 0 0 1]\n"
        f"doffs={scale}\nbaseline=100\nwidth={width}\nheight={height}\n"
        f"ndisp={16 * scale}\nisint=0\n"
    )


def write_scene_of_2003(folder: Path) -> None:
    """Without calibration and range: 450 pixels wide are a quarter of the full size."""
    folder.mkdir(parents=True)
    world = noise(4, (40, 480))
    cv2.imwrite(str(folder / "im2.png"), world[:, :450])
    cv2.imwrite(str(folder / "im6.png"), world[:, 9:459])
    cv2.imwrite(str(folder / "disp2.png"), np.full((40, 450), 36, np.uint8))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    write_scene(folder / "MiddEval3" / "trainingQ" / "Teddy")
    write_scene(folder / "MiddEval3" / "trainingQ" / "Vintage")
    write_scene(folder / "MiddEval3" / "trainingH" / "Piano", 2, truth=False)
    write_scene(folder / "MiddEval3" / "trainingH" / "Teddy", 2, truth=False)
    write_scene_of_2003(folder / "2003" / "Cones")
    return folder


@pytest.fixture(scope="module")
def run(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """All scenes with three matchers: what was printed, the folder, the errors' stream."""
    out = tmp_path_factory.mktemp("out") / "run"
    done = refusals.run(
        "evaluate", "middlebury", scenes, "--matcher", MATCHERS, "--out", out, "--json",
        "--truth", scenes / "MiddEval3" / "trainingQ", "--parallel", "2",
    )  # fmt: skip
    assert done.code == 0, done.err
    return json.loads(done.out), out, done.err


def test_every_matcher_has_all_scenes_and_matches_them_nearly_everywhere(run: Run) -> None:
    summary = run[0]
    assert list(summary["matchers"]) == MATCHERS.split(",")
    for name, found in summary["matchers"].items():
        assert (found["weighted"]["confidence"] is None) == name.startswith("opencv")
        assert len(found["scenes"]) == 4
        for mask in ("nonocc", "all"):
            assert set(found["weighted"][mask]) == {"dense", "sparse", "invalid"}
            for figures in (found["weighted"][mask][holes] for holes in ("dense", "sparse")):
                assert set(figures["bad"]) == {"0.5", "1", "2", "4"}
                assert {"avgerr", "rms", "a50", "a90", "a95", "a99"} <= set(figures)
        # Only pixels at the outline of the square are hard: a tenth of the image at most.
        assert 0 <= found["weighted"]["nonocc"]["dense"]["bad"]["4"] < 12
        depth = found["scenes"]["MiddEval3/trainingQ/Teddy"]["nonocc"]["dense"]["depth"]
        # OpenCV's step, a 16th of a pixel, is 25 mm at 2 m with this rig.
        assert 0 <= depth["median_m"] < 0.03


def test_the_mean_is_weighted_as_the_table_is(run: Run) -> None:
    found = run[0]["matchers"]["sad"]
    scenes = found["scenes"]
    weights = [one["weight"] for one in scenes.values()]
    assert scenes["MiddEval3/trainingQ/Vintage"]["weight"] == 4
    seconds = [one["seconds"] for one in scenes.values()]
    assert found["weighted"]["seconds"] == pytest.approx(np.average(seconds, weights=weights))
    errors = [one["nonocc"]["dense"]["avgerr"] for one in scenes.values()]
    mean = found["weighted"]["nonocc"]["dense"]["avgerr"]
    assert mean == pytest.approx(np.average(errors, weights=weights))


def test_a_scene_without_truth_is_scored_with_that_of_another_size_or_skipped_by_name(
    run: Run,
) -> None:
    summary, _, errors = run
    assert summary["skipped"] == ["MiddEval3/trainingH/Piano"]
    assert "warning: MiddEval3/trainingH/Piano: no truth" in errors
    half = summary["matchers"]["sad"]["scenes"]["MiddEval3/trainingH/Teddy"]
    assert (half["width_px"], half["full_size_factor"], half["ndisp"]) == (2 * WIDTH, 4, 32)


def test_a_scene_without_a_published_range_is_searched_as_far_as_its_truth(run: Run) -> None:
    cones = run[0]["matchers"]["opencv-sgbm"]["scenes"]["2003/Cones"]
    assert cones["ndisp"] == 16
    assert cones["nonocc"]["sparse"]["a50"] < 1
    assert "depth" not in cones["nonocc"]["dense"]


def test_tables_maps_and_images_are_written(run: Run) -> None:
    summary, out, _ = run
    assert json.loads((out / "summary.json").read_text()) == summary
    assert "| sad |" in (out / "tables.md").read_text()
    assert "Weighted mean, nonocc, dense" in (out / "tables.txt").read_text()
    rows = list(csv.DictReader((out / "figures.csv").open()))
    assert len(rows) == 3 * (4 + 1) * 4
    mean = next(r for r in rows if r["scene"] == "weighted" and r["matcher"] == "sad")
    expected = summary["matchers"]["sad"]["weighted"]["nonocc"]["dense"]["bad"]["2"]
    assert float(mean["bad2"]) == pytest.approx(expected, rel=1e-5)
    report = (out / "report.html").read_text()
    assert all(title in report for title in ("Reliability", "Sparsification", "2003/Cones"))
    image = read_image(out / "pictures/sad/MiddEval3/trainingQ/Teddy_error.png")
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert (out / "disparity/opencv-bm/MiddEval3/trainingH/Teddy.pfm").is_file()


def test_figures_do_not_depend_on_what_runs_beside(scenes: Path, run: Run, tmp_path: Path) -> None:
    done = refusals.run(
        "evaluate", "middlebury", scenes / "MiddEval3" / "trainingQ", "--out", tmp_path / "run",
        "--json", "--quiet", "--threads", "1",
    )  # fmt: skip
    assert done.err == ""
    alone = json.loads(done.out)["matchers"]["sad"]["scenes"]["Vintage"]["nonocc"]
    assert alone == run[0]["matchers"]["sad"]["scenes"]["MiddEval3/trainingQ/Vintage"]["nonocc"]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("nowhere",), "does not exist"),
        (("empty",), "no Middlebury scene"),
        (("MiddEval3/trainingH",), "no scene has ground truth"),
        (("MiddEval3/trainingH", "--truth", "nowhere"), "nowhere: folder does not exist"),
        (("MiddEval3/trainingQ", "--matcher", "sad,nonsense"), "unknown matcher"),
        (("MiddEval3/trainingQ", "--matcher", "sad,sad"), "named twice"),
        (("MiddEval3/trainingQ", "--matcher", "onnx"), "matching.onnx.model"),
        (("damaged",), "im1.png"),
    ],
)
def test_what_cannot_be_evaluated_gets_one_line(
    scenes: Path, tmp_path: Path, arguments: tuple[str, ...], word: str
) -> None:
    folder = scenes / arguments[0]
    if arguments[0] in {"empty", "damaged"}:
        folder = tmp_path / arguments[0]
        folder.mkdir()
    if arguments[0] == "damaged":
        shutil.copytree(scenes / "MiddEval3" / "trainingQ" / "Teddy", folder / "Teddy")
        (folder / "Teddy/im1.png").write_bytes(b"\x89PNG")
    out = tmp_path / "out"
    done = refusals.run("evaluate", "middlebury", folder, *arguments[1:], "--out", out, "--quiet")
    assert (done.code, done.out) == (1, "")
    assert len(done.err.splitlines()) == 1
    assert done.err.startswith("error: ")
    assert word in done.err
    assert not out.exists()


def test_the_range_can_be_found_from_the_pairs(scenes: Path, tmp_path: Path) -> None:
    scene = tmp_path / "Teddy"
    shutil.copytree(scenes / "MiddEval3/trainingQ/Teddy", scene)
    calib = (scene / "calib.txt").read_text()
    (scene / "calib.txt").write_text(calib.replace("ndisp=16", "ndisp=90"))
    options = ["--matcher", "sad,opencv-bm", "--range", "auto", "--json", "--quiet"]
    done = refusals.run("evaluate", "middlebury", scene, *options, "--out", tmp_path / "run")
    assert done.code == 0, done.err
    for found in json.loads(done.out)["matchers"].values():
        # Nothing is nearer than 12 px, so the usual tenth of the width is enough.
        assert found["scenes"]["Teddy"]["ndisp"] == 16


def test_one_map_is_compared_in_either_format(tmp_path: Path) -> None:
    truth = np.full((4, 10), 20, np.float32)
    estimate = truth.copy()
    estimate[0, :5] += 8  # an eighth of all: off by 8 pixels and 40 %
    estimate[1, 0] = np.nan
    write_disparity_png(tmp_path / "gt.png", truth)
    write_pfm(tmp_path / "est.pfm", estimate)
    done = refusals.run(
        "evaluate", "disparity", tmp_path / "est.pfm", tmp_path / "gt.png", "--json"
    )
    assert done.code == 0, done.err
    figures = json.loads(done.out)
    assert figures["pixels"] == 40
    assert figures["invalid"] == pytest.approx(2.5)
    assert figures["sparse"]["bad"]["2"] == figures["sparse"]["d1"] == pytest.approx(12.5)
    assert figures["dense"]["avgerr"] == pytest.approx(1.0)

    mask = np.zeros((4, 10), np.uint8)
    mask[1:] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    masked = ("--mask", tmp_path / "mask.png", "--json")
    done = refusals.run("evaluate", "disparity", tmp_path / "est.pfm", tmp_path / "gt.png", *masked)
    assert json.loads(done.out)["sparse"]["bad"]["0.5"] == 0


def test_the_confidence_of_one_map_is_judged_where_a_file_is_given(tmp_path: Path) -> None:
    truth = np.full((4, 10), 20, np.float32)
    estimate = truth.copy()
    estimate[0] += 8
    files = [tmp_path / name for name in ("est.pfm", "gt.pfm", "sure.pfm", "wild.pfm")]
    sure = np.full((4, 10), 0.75, np.float32)
    for file, values in zip(files, (estimate, truth, sure, sure + 1), strict=True):
        write_pfm(file, values)
    command = ("evaluate", "disparity", *files[:2], "--confidence")
    figures = json.loads(refusals.run(*command, files[2], "--json").out)["confidence"]
    assert figures["ece"] == pytest.approx(0)
    assert figures["reliability"]["right"][7] == pytest.approx(0.75)
    done = refusals.run(*command, files[3])
    assert (done.code, len(done.err.splitlines())) == (1, 1)
    assert "not between 0 and 1" in done.err


def test_maps_of_two_sizes_are_refused_in_one_line(tmp_path: Path) -> None:
    write_pfm(tmp_path / "a.pfm", np.ones((3, 4), np.float32))
    write_pfm(tmp_path / "b.pfm", np.ones((3, 5), np.float32))
    done = refusals.run("evaluate", "disparity", tmp_path / "a.pfm", tmp_path / "b.pfm")
    assert (done.code, len(done.err.splitlines())) == (1, 1)
    assert "differ in size" in done.err


def test_a_pair_is_matched_by_the_matcher_that_is_named(scenes: Path, tmp_path: Path) -> None:
    scene = scenes / "MiddEval3" / "trainingQ" / "Teddy"
    images = (scene / "im0.png", scene / "im1.png")
    medians = {}
    for name in ("sad", "opencv-sgbm"):
        out = tmp_path / name
        done = refusals.run("disparity", *images, "--matcher", name, "--ndisp", "16", "--out", out)
        assert done.code == 0, done.err
        assert f"matcher: {name}" in (out / "config.yaml").read_text()
        medians[name] = json.loads((out / "summary.json").read_text())["disparity_median_px"]
    assert medians["sad"] == pytest.approx(FAR, abs=0.2)
    assert medians["opencv-sgbm"] == pytest.approx(FAR, abs=0.2)
