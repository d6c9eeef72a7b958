"""Tables of an evaluation agree with its figures."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from typing import Any

from recon.report.middlebury_page import csv_table, middlebury_tables
from recon.report.table import Table, join


def masked(error: float | None, *, depth: bool) -> dict[str, Any]:
    one: dict[str, Any] = dict.fromkeys(("avgerr", "rms", "a50", "a90", "a95", "a99"), error)
    one["bad"] = {"0.5": 40.0, "1": 30.0, "2": 20.0, "4": 10.0}
    if depth:
        names = ("mean_m", "median_m", "rms_m", "median_percent", "over_5_percent", "infinite")
        one["depth"] = dict.fromkeys(names, 0.5)
    return {"dense": one, "sparse": one, "invalid": 12.5}


def summary(error: float | None = 3.25, *, depth: bool = True) -> dict[str, Any]:
    """Two scenes and two matchers, of which only the first has a confidence."""
    figures = {mask: masked(error, depth=depth) for mask in ("nonocc", "all")}
    scenes = {name: {**figures, "seconds": 0.5} for name in ("Piano", "Teddy")}
    weighted = {**figures, "seconds": 0.5}
    found = {"scenes": scenes, "weighted": weighted}
    rated = dict.fromkeys(("ece", "ause", "within_1_sigma", "within_2_sigma"), 0.125)
    sure = {name: {**one, "confidence": rated} for name, one in scenes.items()}
    sad = {"scenes": sure, "weighted": {**weighted, "confidence": rated}}
    return {"matchers": {"sad": sad, "opencv-bm": found}, "mean_over": list(scenes)}


def tables(found: dict[str, Any], form: Callable[[Table], str] = Table.text) -> dict[str, list]:
    """The lines of each table, by its title."""
    parts = join(map(form, middlebury_tables(found))).strip("\n").split("\n\n")
    return {
        title.lstrip("#% ").partition(" (bad")[0]: lines
        for title, *lines in map(str.splitlines, parts)
    }


def csv_rows(found: dict[str, Any]) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(csv_table(found))))


def test_a_table_has_a_row_per_matcher_and_a_column_per_figure() -> None:
    first = tables(summary())["Weighted mean, nonocc, dense"]
    assert " ".join(first[1].split()[:8]) == "sad 40.00 30.00 20.00 10.00 12.50 3.25 3.25"
    assert len({line[-4:] for line in first[1:]}) == 1
    for lines in tables(summary(), Table.markdown).values():
        assert len({line.count("|") for line in lines}) == 1


def test_csv_has_every_scene_mask_and_filling_and_the_confidence_where_it_is_counted() -> None:
    rows = csv_rows(summary())
    assert len(rows) == 2 * 3 * 4
    assert (rows[0]["scene"], rows[0]["depth_median_m"], rows[0]["bad0.5"]) == (
        "Piano",
        "0.5",
        "40",
    )
    counted = [(row["matcher"], row["mask"], row["holes"]) for row in rows if row["ece"]]
    assert counted == 3 * [("sad", "all", "sparse")]


def test_seconds_in_the_row_of_means_are_their_mean() -> None:
    given = summary()
    for scene, seconds in (("Piano", 0.25), ("Teddy", 0.75)):
        given["matchers"]["sad"]["scenes"][scene]["seconds"] = seconds
    head, sad, _ = tables(given)["Weighted mean, nonocc, dense"]
    assert (head.split()[-1], sad.split()[-1]) == ("seconds", "0.500")
    assert {row["seconds"] for row in csv_rows(given) if row["scene"] == "weighted"} == {"0.5"}


def test_a_figure_that_is_not_known_is_a_dash_or_an_empty_cell() -> None:
    found = tables(summary())
    rows = found["Confidence, weighted mean, all, sparse"]
    assert rows[1].split() == ["sad", "0.125", "0.125", "0.125", "0.125"]
    assert rows[2].split() == ["opencv-bm", "–", "–", "–", "–"]
    assert found["ece of each scene"][1].split() == ["Piano", "0.125", "–"]
    given = summary(None, depth=False)
    assert "–" in tables(given)["Weighted mean, nonocc, dense"][1]
    assert csv_rows(given)[0]["avgerr"] == csv_rows(given)[0]["depth_mean_m"] == ""


def test_the_best_of_several_is_bold_in_latex() -> None:
    given = summary()
    given["matchers"]["sad"]["weighted"]["seconds"] = 0.25
    better = masked(2.5, depth=True)
    given["matchers"]["opencv-bm"]["scenes"]["Teddy"] = {"nonocc": better, "seconds": 0.125}
    found = tables(given, Table.latex)
    begin, *_, sad, other, _, end = found["Weighted mean, nonocc, dense"]
    assert (begin, end) == (r"\begin{tabular}{lrrrrrrrrrrrrr}", r"\end{tabular}")
    assert sad.endswith(r"\textbf{0.250} \\")
    assert other.endswith(r" & 0.500 \\")
    # Equal values are all the best.
    assert sad.count("textbf") == other.count("textbf") + 1
    errors = found["avgerr (px) of each scene, nonocc, dense"]
    assert errors[5] == r"Teddy & 3.25 & \textbf{2.50} \\"
    assert "textbf" not in "".join(found["Confidence, weighted mean, all, sparse"])


def test_signs_of_latex_are_escaped() -> None:
    table = Table("t", ("my_method", "50 %"), [("a&b–c", "{x}~^#$\\")]).latex()
    assert r"my\_method & 50 \% \\" in table
    assert r"a\&b--c & \{x\}\textasciitilde{}\textasciicircum{}\#\$\textbackslash{} \\" in table


def test_means_over_some_of_the_scenes_say_so() -> None:
    given = summary() | {"mean_over": ["Piano"]}
    del given["matchers"]["opencv-bm"]["scenes"]["Teddy"]
    found = tables(given)
    assert "Weighted mean of 1 of 2 scenes, nonocc, dense" in found
    assert found["seconds of each scene, matching alone"][2].split() == ["Teddy", "0.500", "–"]
