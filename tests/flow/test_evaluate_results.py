"""`recon evaluate middlebury --results`: results of other programs beside ours."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import recon
from recon.cli import app
from recon.io.images.disparity import read_pfm, write_pfm
from tests.flow.test_evaluate import WIDTH, write_scene


def evaluate(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["evaluate", "middlebury", *map(str, arguments), "--quiet"])


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "trainingQ"
    for name in ("Piano", "Teddy", "Vintage"):
        write_scene(folder / name)
    return folder


def truth(scenes: Path, name: str = "Teddy") -> np.ndarray:
    return read_pfm(scenes / name / "disp0GT.pfm")


def doubled(values: np.ndarray) -> np.ndarray:
    return 2 * np.kron(values, np.ones((2, 2), np.float32))


@pytest.fixture(scope="module")
def results(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods: one off by half a pixel, one perfect and at twice the size."""
    folder = tmp_path_factory.mktemp("results")
    for name in ("Piano", "Teddy", "Vintage"):
        write_pfm(folder / "mine" / f"{name}.pfm", truth(scenes, name) + np.float32(0.5))
        inside = folder / "theirs" / "trainingQ" / name
        write_pfm(inside / "disp0BEST.pfm", doubled(truth(scenes, name)))
        write_pfm(inside / "disp0BEST_s.pfm", np.full((4, 4), np.nan, np.float32))
        (inside / "timeBEST.txt").write_text("1.5\n")
    return folder


@pytest.fixture(scope="module")
def run(
    scenes: Path, results: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[dict[str, Any], Path]:
    out = tmp_path_factory.mktemp("out") / "run"
    both = ("--results", results / "mine", "--results", results / "theirs")
    done = evaluate(scenes, "--matcher", "opencv-bm", *both, "--out", out, "--json")
    assert done.exit_code == 0, done.stderr
    return json.loads(done.stdout), out


def test_each_folder_is_a_column_beside_ours(run: tuple[dict[str, Any], Path]) -> None:
    summary, out = run
    assert list(summary["matchers"]) == ["opencv-bm", "mine", "theirs"]
    # Half a pixel at quarter size is two full-size pixels, and 2 is not above 2.
    mine = summary["matchers"]["mine"]["weighted"]["nonocc"]["dense"]
    assert (mine["avgerr"], mine["bad"]["1"], mine["bad"]["2"]) == (2, 100, 0)
    theirs = summary["matchers"]["theirs"]["weighted"]
    assert theirs["all"]["sparse"]["avgerr"] == theirs["all"]["invalid"] == 0
    assert (theirs["seconds"], summary["matchers"]["mine"]["weighted"]["seconds"]) == (1.5, None)
    assert len(summary["mean_over"]) == 3
    report = (out / "report.html").read_text()
    assert "opencv-bm, mine, theirs" in report
    rows = list(csv.DictReader((out / "figures.csv").open()))
    assert {row["seconds"] for row in rows if row["matcher"] == "mine"} == {""}
    assert r"\textbf{0.00}" in (out / "tables.tex").read_text()
    assert (out / "pictures/theirs/Teddy_error.png").is_file()
    assert {path.name for path in (out / "disparity").iterdir()} == {"opencv-bm"}


def test_a_result_of_ours_read_again_has_the_same_figures(
    scenes: Path, run: tuple[dict[str, Any], Path], tmp_path: Path
) -> None:
    summary, out = run
    again = ("--matcher", "none", "--results", out / "disparity" / "opencv-bm")
    done = evaluate(scenes, *again, "--out", tmp_path / "run", "--json")
    assert done.exit_code == 0, done.stderr
    (read,) = json.loads(done.stdout)["matchers"].values()
    made = summary["matchers"]["opencv-bm"]
    assert read["weighted"]["nonocc"] == made["weighted"]["nonocc"]


def test_missing_scenes_are_named_and_left_out_of_all_means(
    scenes: Path, results: Path, tmp_path: Path
) -> None:
    write_pfm(tmp_path / "part" / "Teddy.pfm", truth(scenes) + np.float32(3))
    given = ("--matcher", "none", "--results", tmp_path / "part", "--results", results / "mine")
    done = evaluate(scenes, *given, "--out", tmp_path / "run")
    assert done.exit_code == 0, done.stderr
    assert (
        "part: no result for Piano, Vintage; means are over 1 of 3 scenes, which all have"
        in done.stderr
    )
    assert "Weighted mean of 1 of 3 scenes, nonocc, dense" in done.stdout
    found = json.loads((tmp_path / "run/summary.json").read_text())
    assert found["mean_over"] == ["Teddy"]
    assert list(found["matchers"]["part"]["scenes"]) == ["Teddy"]
    assert list(found["matchers"]["mine"]["scenes"]) == ["Piano", "Teddy", "Vintage"]


def test_folders_of_one_name_are_distinguished(scenes: Path, tmp_path: Path) -> None:
    both: list[str | Path] = []
    for method in ("a", "b"):
        write_pfm(tmp_path / method / "maps" / "Teddy.pfm", truth(scenes))
        both += ["--results", tmp_path / method / "maps"]
    done = evaluate(scenes, "--matcher", "none", *both, "--out", tmp_path / "run", "--json")
    assert list(json.loads(done.stdout)["matchers"]) == ["a/maps", "b/maps"]


def test_the_truth_beside_a_result_is_not_taken_for_it(scenes: Path, tmp_path: Path) -> None:
    folder = tmp_path / "trainingQ"
    write_scene(folder / "Teddy")
    done = evaluate(folder, "--results", folder, "--out", tmp_path / "run")
    assert "no result for any scene" in done.stderr
    write_pfm(folder / "Teddy" / "disp0MINE.pfm", truth(scenes) + np.float32(1))
    options = ("--matcher", "none", "--json", "--out", tmp_path / "run")
    done = evaluate(folder, "--results", folder, *options)
    (found,) = json.loads(done.stdout)["matchers"].values()
    assert found["weighted"]["nonocc"]["dense"]["avgerr"] == 4


def test_latex_is_printed_alone(scenes: Path, results: Path, tmp_path: Path) -> None:
    given = ("--matcher", "none", "--results", results / "mine", "--out", tmp_path / "run")
    done = evaluate(scenes, *given, "--latex")
    assert done.exit_code == 0
    title, begin = done.stdout.splitlines()[:2]
    assert title.startswith("% Weighted mean, nonocc, dense (bad and invalid in %")
    assert begin.startswith(r"\begin{tabular}")
    assert done.stdout.rstrip().endswith(r"\end{tabular}")
    assert done.stderr.startswith("results: ")


def broken(scenes: Path, folder: Path, kind: str) -> tuple[str | Path, ...]:
    """Arguments that cannot be evaluated."""
    given = folder / "given"
    file = given / ("Teddy/disp0.pfm" if kind in {"several", "time"} else "Teddy.pfm")
    write_pfm(file, np.ones((7, WIDTH), np.float32) if kind == "size" else truth(scenes))
    if kind == "several":
        write_pfm(file.with_name("disp0B.pfm"), truth(scenes))
    if kind == "time":
        file.with_name("time.txt").write_text("fast")
    if kind == "colour":
        file.write_bytes(b"PF\n1 1\n-1\n" + bytes(12))
    if kind == "nothing":
        return ()
    named = ("--results", folder / "nowhere" if kind == "nowhere" else given)
    return 2 * named if kind == "twice" else named


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("nowhere", "nowhere: folder does not exist"),
        ("size", "Teddy.pfm: result and truth differ in size"),
        ("several", "Teddy: folder has several results for one scene (got disp0.pfm, disp0B.pfm)"),
        ("time", "time.txt:1: not a number"),
        ("colour", "Teddy.pfm: PFM file is in colour"),
        ("twice", "given twice"),
        ("nothing", "nothing to evaluate"),
    ],
)
def test_results_that_cannot_be_evaluated_get_one_line(
    scenes: Path, tmp_path: Path, kind: str, words: str
) -> None:
    out = tmp_path / "run"
    done = evaluate(scenes, *broken(scenes, tmp_path, kind), "--matcher", "none", "--out", out)
    assert done.exit_code == 1
    assert len(done.stderr.splitlines()) == 1
    assert words in done.stderr
    assert not out.exists()


class Known:
    """Knows the answer, and says so half of the time."""

    name = "known"

    def match(self, pair: recon.RectifiedPair) -> recon.Disparity:
        values = np.full(pair.left.shape, 4.0)
        values[:, ::2] = np.nan
        return recon.Disparity.from_values(values)


def test_a_matcher_of_ones_own_is_a_column_too(scenes: Path, results: Path, tmp_path: Path) -> None:
    mine, out = [str(results / "mine")], tmp_path / "run"
    summary = recon.run_middlebury(str(scenes), matchers=[Known()], results=mine, out=out)
    assert list(summary["matchers"]) == ["known", "mine"]
    weighted = summary["matchers"]["known"]["weighted"]
    assert weighted["all"]["invalid"] == 50
    # The same confidence everywhere is none.
    assert weighted["confidence"] is None
    assert (tmp_path / "run/disparity/known/Teddy.pfm").is_file()
