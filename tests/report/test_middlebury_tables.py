"""Tables of an evaluation agree with its figures."""

from __future__ import annotations

import csv
import io
from typing import Any

from recon.report.middlebury_tables import csv_table, middlebury_tables
from recon.report.table import Table, join


def masked(error: float | None, *, depth: bool) -> dict[str, Any]:
    one: dict[str, Any] = dict.fromkeys(("avgerr", "rms", "a50", "a90", "a95", "a99"), error)
    one["bad"] = {"0.5": 40.0, "1": 30.0, "2": 20.0, "4": 10.0}
    if depth:
        names = ("mean_m", "median_m", "rms_m", "median_percent", "over_5_percent", "infinite")
        one["depth"] = dict.fromkeys(names, 0.5)
    return {"dense": one, "sparse": one, "invalid": 12.5}


def summary(error: float | None = 3.25, *, depth: bool = True) -> dict[str, Any]:
    figures = {mask: masked(error, depth=depth) for mask in ("nonocc", "all")}
    scenes = {name: {**figures, "seconds": 0.5} for name in ("Piano", "Teddy")}
    weighted = {**figures, "seconds": 0.5}
    found = {"scenes": scenes, "weighted": weighted}
    rated = dict.fromkeys(("ece", "ause", "within_1_sigma", "within_2_sigma"), 0.125)
    sure = {name: {**one, "confidence": rated} for name, one in scenes.items()}
    sad = {"scenes": sure, "weighted": {**weighted, "confidence": rated}}
    return {"matchers": {"sad": sad, "opencv-bm": found}, "mean_over": list(scenes)}


def text_tables(found: dict[str, Any]) -> str:
    return join(map(Table.text, middlebury_tables(found)))


def test_a_table_has_a_row_per_matcher_and_a_column_per_figure() -> None:
    text = text_tables(summary())
    first = text.split("\n\n")[0].splitlines()
    assert first[0] == "Weighted mean, nonocc, dense"
    assert first[2].split()[:8] == [
        "sad",
        "40.00",
        "30.00",
        "20.00",
        "10.00",
        "12.50",
        "3.25",
        "3.25",
    ]
    assert len({line.rstrip()[-4:] for line in first[2:]}) == 1


def test_seconds_in_the_row_of_means_are_their_mean() -> None:
    given = summary()
    for scene, seconds in (("Piano", 0.25), ("Teddy", 0.75)):
        given["matchers"]["sad"]["scenes"][scene]["seconds"] = seconds
    first = text_tables(given).split("\n\n")[0].splitlines()
    assert first[1].split()[-1] == "seconds"
    assert first[2].split()[-1] == "0.500"
    rows = list(csv.DictReader(io.StringIO(csv_table(given))))
    assert {row["seconds"] for row in rows if row["scene"] == "weighted"} == {"0.5"}


def test_markdown_has_as_many_cells_in_each_row() -> None:
    for table in join(map(Table.markdown, middlebury_tables(summary()))).split("\n\n"):
        assert len({line.count("|") for line in table.splitlines()[1:]}) == 1


def test_csv_has_every_scene_mask_and_filling() -> None:
    rows = list(csv.DictReader(io.StringIO(csv_table(summary()))))
    assert len(rows) == 2 * 3 * 4
    assert rows[0]["scene"] == "Piano"
    assert float(rows[0]["depth_median_m"]) == 0.5


def test_the_confidence_of_a_matcher_that_has_none_is_a_dash() -> None:
    tables = dict(part.split("\n", 1) for part in text_tables(summary()).split("\n\n"))
    rows = tables["Confidence, weighted mean, all, sparse"].splitlines()
    assert rows[1].split() == ["sad", "0.125", "0.125", "0.125", "0.125"]
    assert rows[2].split() == ["opencv-bm", "–", "–", "–", "–"]
    assert tables["ece of each scene"].splitlines()[1].split() == ["Piano", "0.125", "–"]


def test_csv_has_the_confidence_where_it_is_counted() -> None:
    rows = list(csv.DictReader(io.StringIO(csv_table(summary()))))
    counted = [row for row in rows if row["ece"]]
    assert {(row["matcher"], row["mask"], row["holes"]) for row in counted} == {
        ("sad", "all", "sparse")
    }
    assert len(counted) == 3


def test_a_figure_that_is_not_known_is_a_dash_or_an_empty_cell() -> None:
    given = summary(None, depth=False)
    assert "–" in text_tables(given)
    row = next(csv.DictReader(io.StringIO(csv_table(given))))
    assert row["avgerr"] == row["depth_mean_m"] == ""


def test_the_best_of_several_is_bold_in_latex() -> None:
    given = summary()
    given["matchers"]["sad"]["weighted"]["seconds"] = 0.25
    better = masked(2.5, depth=True)
    given["matchers"]["opencv-bm"]["scenes"]["Teddy"] = {"nonocc": better, "seconds": 0.125}
    tables = {
        part.partition("\n")[0]: part.splitlines()
        for part in join(map(Table.latex, middlebury_tables(given))).split("\n\n")
    }
    mean = tables["% Weighted mean, nonocc, dense"]
    assert mean[1] == r"\begin{tabular}{lrrrrrrrrrrrrr}"
    assert mean[5].endswith(r"\textbf{0.250} \\")
    assert mean[6].endswith(r" & 0.500 \\")
    # Equal values are all the best.
    assert mean[5].count("textbf") == mean[6].count("textbf") + 1
    errors = tables["% avgerr (px) of each scene, nonocc, dense"]
    assert errors[6] == r"Teddy & 3.25 & \textbf{2.50} \\"
    sure = tables["% Confidence, weighted mean, all, sparse"]
    assert not any("textbf" in line for line in sure)
    assert all(lines[-1] == r"\end{tabular}" for lines in tables.values())


def test_signs_of_latex_are_escaped() -> None:
    table = Table("t", ("my_method", "50 %"), [("a&b–c", "{x}~^#$\\")]).latex()
    assert r"my\_method & 50 \% \\" in table
    assert r"a\&b--c & \{x\}\textasciitilde{}\textasciicircum{}\#\$\textbackslash{} \\" in table


def test_means_over_some_of_the_scenes_say_so() -> None:
    given = summary() | {"mean_over": ["Piano"]}
    del given["matchers"]["opencv-bm"]["scenes"]["Teddy"]
    text = text_tables(given)
    assert "Weighted mean of 1 of 2 scenes, nonocc, dense" in text
    assert "Teddy  0.500          –" in text
