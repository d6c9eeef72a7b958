"""`recon evaluate middlebury` and `recon evaluate disparity` from files to figures."""

import csv
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import recon
from recon.io.images.disparity import read_pfm, write_disparity_png, write_pfm
from recon.io.images.image import read_image
from tests.flow.runs import summary_of
from tests.hostile.refusals import Ended, assert_refused, run
from tests.scenery.middlebury import HEIGHT, WIDTH, noise, square, write_scene

MATCHERS = ("sad", "opencv-bm", "opencv-sgbm")


def middlebury(*words: str | Path) -> Ended:
    return run("evaluate", "middlebury", *words, "--quiet")


def printed(ended: Ended) -> dict[str, Any]:
    assert ended.code == 0, ended.err
    return dict(json.loads(ended.out))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    for name in ("Teddy", "Vintage"):
        write_scene(folder / "MiddEval3" / "trainingQ" / name, square())
    for name in ("Piano", "Teddy"):
        write_scene(folder / "MiddEval3" / "trainingH" / name, square(2), truth=False)
    # One of 2003 without calibration and range: 450 pixels wide are a quarter of the full size.
    world, cones = noise(4, (40, 480)), folder / "2003" / "Cones"
    cones.mkdir(parents=True)
    cv2.imwrite(str(cones / "im2.png"), world[:, :450])
    cv2.imwrite(str(cones / "im6.png"), world[:, 9:459])
    cv2.imwrite(str(cones / "disp2.png"), np.full((40, 450), 36, np.uint8))
    return folder


@pytest.fixture(scope="module")
def quarter(scenes):
    return scenes / "MiddEval3" / "trainingQ"


@pytest.fixture(scope="module")
def truth(quarter):
    return read_pfm(quarter / "Teddy" / "disp0GT.pfm")


@pytest.fixture(scope="module")
def matched(scenes, quarter, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "run"
    done = run(
        "evaluate", "middlebury", scenes, "--matcher", ",".join(MATCHERS), "--out", out, "--json",
        "--truth", quarter, "--parallel", "2",
    )  # fmt: skip
    assert summary_of(out) == printed(done)
    assert "warning: MiddEval3/trainingH/Piano: no truth" in done.err
    return out


def test_every_matcher_has_all_scenes_and_matches_them_nearly_everywhere(matched):
    summary = summary_of(matched)
    assert tuple(summary["matchers"]) == MATCHERS
    assert summary["skipped"] == ["MiddEval3/trainingH/Piano"]
    for name, found in summary["matchers"].items():
        assert (found["weighted"]["confidence"] is None) == name.startswith("opencv")
        scenes = found["scenes"]
        assert len(scenes) == 4
        for mask in ("nonocc", "all"):
            kinds = {"measured", "inferred"}
            assert set(found["weighted"][mask]) == {"dense", "sparse", "invalid", *kinds}
            for figures in (found["weighted"][mask][n] for n in ("dense", "sparse", "measured")):
                assert set(figures["bad"]) == {"0.5", "1", "2", "4"}
                assert {"avgerr", "rms", "a50", "a90", "a95", "a99"} <= set(figures)
        # Only pixels at the outline of the square are hard: a tenth of the image at most.
        assert 0 <= found["weighted"]["nonocc"]["dense"]["bad"]["4"] < 12
        depth = scenes["MiddEval3/trainingQ/Teddy"]["nonocc"]["dense"]["depth"]
        # OpenCV's step, a 16th of a pixel, is 25 mm at 2 m with this rig.
        assert 0 <= depth["median_m"] < 0.03
        seconds, weights = zip(*((s["seconds"], s["weight"]) for s in scenes.values()), strict=True)
        assert found["weighted"]["seconds"] == pytest.approx(np.average(seconds, weights=weights))
        # Scored with the truth of another size.
        half = scenes["MiddEval3/trainingH/Teddy"]
        assert (half["width_px"], half["full_size_factor"], half["ndisp"]) == (2 * WIDTH, 4, 32)
        # Without a published range it is searched as far as its truth.
        cones = scenes["2003/Cones"]
        assert cones["ndisp"] == 16
        assert "depth" not in cones["nonocc"]["dense"]
    assert cones["nonocc"]["sparse"]["a50"] < 1


def test_tables_maps_and_images_are_written(matched):
    weighted = summary_of(matched)["matchers"]["sad"]["weighted"]
    assert "| sad |" in (matched / "tables.md").read_text()
    assert "Weighted mean, nonocc, dense" in (matched / "tables.txt").read_text()
    rows = list(csv.DictReader((matched / "figures.csv").open()))
    assert len(rows) == 3 * (4 + 1) * 4
    mean = next(r for r in rows if r["scene"] == "weighted" and r["matcher"] == "sad")
    assert float(mean["bad2"]) == pytest.approx(weighted["nonocc"]["dense"]["bad"]["2"], rel=1e-5)
    report = (matched / "report.html").read_text()
    assert all(title in report for title in ("Reliability", "Sparsification", "2003/Cones"))
    image = read_image(matched / "pictures/sad/MiddEval3/trainingQ/Teddy_error.png")
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert (matched / "disparity/opencv-bm/MiddEval3/trainingH/Teddy.pfm").is_file()


def test_figures_ignore_what_runs_beside(quarter, matched, tmp_path):
    done = middlebury(
        quarter, "--matcher", "sad", "--out", tmp_path / "run", "--json", "--threads", "1"
    )
    alone = printed(done)["matchers"]["sad"]["scenes"]["Vintage"]["nonocc"]
    beside = summary_of(matched)["matchers"]["sad"]["scenes"]
    assert alone == beside["MiddEval3/trainingQ/Vintage"]["nonocc"]
    assert done.err == ""


def test_results_of_a_network_name_it_with_licence_and_training_sets(quarter, tmp_path):
    pytest.importorskip("onnx")
    from tests.stereo.match.networks import write_matcher

    model = write_matcher(tmp_path / "n.onnx", channels=3)
    words = ["--set", f"matching.onnx.model={model}"]
    words += ["--set", "matching.onnx.preset=lite-any-stereo"]
    words += ["--set", "matching.onnx.std=[1]", "--out"]
    scored = printed(middlebury(quarter, "--matcher", "onnx", "--json", *words, tmp_path / "many"))
    images = [quarter / "Teddy" / f"im{n}.png" for n in (0, 1)]
    calib = ["--calib", quarter / "Teddy" / "calib.txt"]
    assert run("pair", *images, *calib, "--matcher", "onnx", *words, tmp_path / "one").code == 0
    network = summary_of(tmp_path / "one")["network"]
    assert network == scored["network"] == summary_of(tmp_path / "many")["network"]
    assert network["sha256"] == hashlib.sha256(model.read_bytes()).hexdigest()
    assert scored["matchers"]["onnx"]["weighted"]["confidence"]["ece"] < 0.3
    for folder in ("one", "many"):
        page = (tmp_path / folder / "report.html").read_text()
        assert network["sha256"] in page
        assert network["trained_on"] in page


@pytest.mark.parametrize(("words", "said"), [
    (["{}/nowhere"], "does not exist"),
    (["{}/MiddEval3/trainingH"], "no scene has ground truth"),
    (["{}/MiddEval3/trainingH", "--truth", "nowhere"], "nowhere: folder does not exist"),
    (["{}/MiddEval3/trainingQ", "--matcher", "sad,nonsense"], "unknown matcher"),
    (["{}/MiddEval3/trainingQ", "--matcher", "sad,sad"], "named twice"),
    (["{}/MiddEval3/trainingQ", "--matcher", "onnx"], "matching.onnx.model"),
    (["{}/MiddEval3/trainingQ", "--matcher", "none"], "nothing to evaluate"),
    (["damaged"], "im1.png"),
    (["{}/MiddEval3/trainingQ", "--results", "nowhere"], "nowhere: folder does not exist"),
    (["{}/MiddEval3/trainingQ", "--results", "size"], "Teddy.pfm: result and truth differ in"),
    (["{}/MiddEval3/trainingQ", "--results", "time"], "time.txt:1: not a number"),
])  # fmt: skip
def test_what_cannot_be_evaluated_gets_one_line(
    scenes, truth, tmp_path, monkeypatch,
    words, said,
):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    shutil.copytree(scenes / "MiddEval3" / "trainingQ" / "Teddy", "damaged/Teddy")
    Path("damaged/Teddy/im1.png").write_bytes(b"\x89PNG")
    write_pfm(Path("size/Teddy.pfm"), truth[:7])
    write_pfm(Path("time/Teddy/disp0.pfm"), truth)
    Path("time/Teddy/time.txt").write_text("fast")
    assert_refused(middlebury(*(word.format(scenes) for word in words), "--out", "out"), said)
    assert not Path("out").exists()


def test_the_range_can_be_found_from_the_pairs(quarter, tmp_path):
    scene = Path(shutil.copytree(quarter / "Teddy", tmp_path / "Teddy"))
    calib = (scene / "calib.txt").read_text()
    (scene / "calib.txt").write_text(calib.replace("ndisp=16", "ndisp=90"))
    options = ["--matcher", "sad,opencv-bm", "--range", "auto", "--json"]
    found = printed(middlebury(scene, *options, "--out", tmp_path / "run"))["matchers"]
    # Nothing is nearer than 12 px, so the usual tenth of the width is enough.
    assert [one["scenes"]["Teddy"]["ndisp"] for one in found.values()] == [16, 16]


@pytest.fixture(scope="module")
def results(quarter, truth, tmp_path_factory):
    """Two methods: one off by half a pixel, one perfect and at twice the size."""
    folder = tmp_path_factory.mktemp("results")
    for name in ("Teddy", "Vintage"):
        write_pfm(folder / "mine" / f"{name}.pfm", truth + np.float32(0.5))
        inside = folder / "theirs" / "trainingQ" / name
        write_pfm(inside / "disp0BEST.pfm", 2 * np.kron(truth, np.ones((2, 2), np.float32)))
        write_pfm(inside / "disp0BEST_s.pfm", np.full((4, 4), np.nan, np.float32))
        (inside / "timeBEST.txt").write_text("1.5\n")
    return folder


def test_each_folder_of_results_is_a_column(quarter, results, tmp_path):
    out, both = tmp_path / "run", [f"--results={results / name}" for name in ("mine", "theirs")]
    done = middlebury(quarter, "--matcher", "opencv-bm", *both, "--out", out, "--json")
    matchers = printed(done)["matchers"]
    assert list(matchers) == ["opencv-bm", "mine", "theirs"]
    # Half a pixel at quarter size is two full-size pixels, and 2 is not above 2.
    mine, theirs = (matchers[name]["weighted"] for name in ("mine", "theirs"))
    figures = mine["nonocc"]["dense"]
    assert (figures["avgerr"], figures["bad"]["1"], figures["bad"]["2"]) == (2, 100, 0)
    assert theirs["all"]["sparse"]["avgerr"] == theirs["all"]["invalid"] == 0
    assert (theirs["seconds"], mine["seconds"]) == (1.5, None)
    assert "opencv-bm, mine, theirs" in (out / "report.html").read_text()
    rows = list(csv.DictReader((out / "figures.csv").open()))
    assert {row["seconds"] for row in rows if row["matcher"] == "mine"} == {""}
    assert r"\textbf{0.00}" in (out / "tables.tex").read_text()
    assert (out / "pictures/theirs/Teddy_error.png").is_file()
    assert {path.name for path in (out / "disparity").iterdir()} == {"opencv-bm"}
    # A result of ours read again has the same figures.
    again = ("--matcher", "none", "--results", out / "disparity" / "opencv-bm")
    done = middlebury(quarter, *again, "--out", tmp_path / "again", "--json")
    (read,) = printed(done)["matchers"].values()
    assert read["weighted"]["nonocc"] == matchers["opencv-bm"]["weighted"]["nonocc"]


def test_missing_scenes_are_named_and_left_out_of_all_means(quarter, truth, results, tmp_path):
    write_pfm(tmp_path / "a" / "maps" / "Teddy.pfm", truth + np.float32(3))
    write_pfm(tmp_path / "b" / "maps" / "Teddy.pfm", truth)
    given = [f"--results={tmp_path / name / 'maps'}" for name in ("a", "b")]
    given += [f"--results={results / 'mine'}", f"--out={tmp_path / 'o'}"]
    done = middlebury(quarter, "--matcher", "none", *given, "--verbose")
    assert done.code == 0, done.err
    means = "means are over 1 of 2 scenes, which all have"
    assert f"a/maps: no result for Vintage; {means}" in done.err
    assert "Weighted mean of 1 of 2 scenes, nonocc, dense" in done.out
    found = summary_of(tmp_path / "o")
    assert found["mean_over"] == ["Teddy"]
    assert list(found["matchers"])[:2] == ["a/maps", "b/maps"]  # of one name, so of two parts
    scenes = [list(one["scenes"]) for one in found["matchers"].values()]
    assert scenes == [["Teddy"], ["Teddy"], ["Teddy", "Vintage"]]


def test_the_truth_is_taken_for_no_result(quarter, truth, tmp_path):
    folder = Path(shutil.copytree(quarter, tmp_path / "trainingQ"))
    done = middlebury(folder, "--results", folder, "--out", tmp_path / "run")
    assert "no result for any scene" in done.err
    write_pfm(folder / "Teddy" / "disp0MINE.pfm", truth + np.float32(1))
    options = ("--matcher", "none", "--json", "--out", tmp_path / "run")
    (found,) = printed(middlebury(folder, "--results", folder, *options))["matchers"].values()
    assert found["weighted"]["nonocc"]["dense"]["avgerr"] == 4


def test_latex_is_printed_alone(quarter, results, tmp_path):
    given = ("--matcher", "none", "--results", results / "mine", "--out", tmp_path / "run")
    done = middlebury(quarter, *given, "--latex")
    assert done.code == 0
    title, begin, *_, end = done.out.strip().splitlines()
    assert title.startswith("% Weighted mean, nonocc, dense (bad and invalid in %")
    assert begin.startswith(r"\begin{tabular}")
    assert end == r"\end{tabular}"
    assert done.err.startswith("results: ")


class Known:
    """Knows the answer, and says so half of the time."""

    name = "known"

    def match(self, pair: recon.RectifiedPair) -> recon.Disparity:
        values = np.full(pair.left.shape, 4.0)
        values[:, ::2] = np.nan
        return recon.Disparity.from_values(values)


def test_ones_own_matcher_is_a_column_too(quarter, results, tmp_path):
    mine, out = [str(results / "mine")], tmp_path / "run"
    summary = recon.run_middlebury(
        str(quarter), matchers=[Known()], results=mine, out=out
    ).to_json()
    assert list(summary["matchers"]) == ["known", "mine"]
    weighted = summary["matchers"]["known"]["weighted"]
    assert weighted["all"]["invalid"] == 50
    # The same confidence everywhere is none.
    assert weighted["confidence"] is None
    assert (out / "disparity/known/Teddy.pfm").is_file()


def test_one_map_is_compared_in_either_format_and_its_confidence_judged(tmp_path):
    files = {name: tmp_path / name for name in ("est.pfm", "gt.png", "mask.png", "sure.pfm")}
    exact = np.full((4, 10), 20, np.float32)
    estimate = exact.copy()
    estimate[0, :5] += 8  # an eighth of all: off by 8 pixels and 40 %
    estimate[1, 0] = np.nan
    write_pfm(files["est.pfm"], estimate)
    write_disparity_png(files["gt.png"], exact)
    command = ("evaluate", "disparity", files["est.pfm"], files["gt.png"])
    figures = printed(run(*command, "--json"))
    assert (figures["pixels"], figures["invalid"]) == (40, pytest.approx(2.5))
    assert figures["sparse"]["bad"]["2"] == figures["sparse"]["d1"] == pytest.approx(12.5)
    assert figures["dense"]["avgerr"] == pytest.approx(1.0)
    mask = np.full((4, 10), 255, np.uint8)
    mask[0] = 0
    cv2.imwrite(str(files["mask.png"]), mask)
    masked = printed(run(*command, "--mask", files["mask.png"], "--json"))
    assert masked["sparse"]["bad"]["0.5"] == 0
    judged = (*command, "--confidence", files["sure.pfm"], "--json")
    write_pfm(files["sure.pfm"], np.full((4, 10), 0.75, np.float32))
    confidence = printed(run(*judged))["confidence"]
    assert confidence["reliability"]["right"][7] == pytest.approx(34 / 39)
    assert confidence["ece"] == pytest.approx(34 / 39 - 0.75)
    write_pfm(files["sure.pfm"], np.full((4, 10), 1.75, np.float32))
    assert_refused(run(*judged), "not between 0 and 1")
    write_pfm(files["est.pfm"], estimate[:, :9])
    assert_refused(run(*command), "differ in size")
