"""The tables of README and docs/results.md, and `make results`, which makes them."""

import importlib
import json
import re
from types import ModuleType
from typing import Any

import pytest

from tests.docs.blocks import ROOT

RECORD = {
    "commands": ["recon doctor"],
    "commit": "0123abc",
    "date": "2026-01-02",
    "machine": {"cpu": "a processor", "cores": 2},
    "load": 3.5,
    "timed": True,
    "columns": {"t_rel": "{:.2f} %", "not trusted": "{}"},
    "rows": {"one": {"t_rel": 0.2, "not trusted": 3}, "other": {"t_rel": 0.3}},
}


@pytest.fixture
def results(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("results")


def measure(results: ModuleType, *names: str) -> Any:
    """Measure some tables; the exit code."""
    with pytest.raises(SystemExit) as end:
        results.main(["--only", *names])
    return end.value.code


@pytest.fixture
def elsewhere(results, tmp_path, monkeypatch):
    """A page and the file of results in a folder of their own."""
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- table: movers -->\nold\n<!-- end -->\nafter\n")
    monkeypatch.setattr(results, "ROOT", tmp_path)
    monkeypatch.setattr(results, "FILE", tmp_path / "results.json")
    monkeypatch.setattr(results, "PAGES", (page,))
    monkeypatch.setattr(results, "measured", lambda name: RECORD)
    return page


def test_the_tables_of_the_pages_are_those_that_were_measured(results):
    assert results.outdated() == []


def test_every_table_has_one_place_and_no_figures_are_typed_elsewhere(results):
    """Figures stand behind the first column: `| 12.3 % |`."""
    pages = [page.read_text() for page in results.PAGES]
    places = [place[2] for text in pages for place in results.PLACE.finditer(text)]
    begun = [name for text in pages for name in re.findall("<!-- table: (.*) -->", text)]
    assert sorted(places) == sorted(begun) == sorted(results.TABLES)
    for text in pages:
        typed = results.PLACE.sub("", text)
        assert re.findall(r"^\|[^|\n]*\|.*?\d[.\d]* (?:%|m|ms|MB)\b.*$", typed, re.MULTILINE) == []


def test_what_was_measured_says_of_which_commit_and_machine_it_is(results):
    for name, record in results.read().items():
        assert re.fullmatch(r"[0-9a-f]{7,}", record["commit"]), name
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", record["date"]), name
        assert record["commands"], name
        assert record["machine"]["cpu"], name
        assert record["machine"]["cores"], name
        assert "kiss-icp" in record["machine"] or "states" in record["note"], name


def test_a_table_says_of_which_commit_and_machine_it_is(results, elsewhere):
    assert measure(results, "movers") == 0
    origin = "commit 0123abc, 2026-01-02, a processor, 2 cores, load 3.5 at the start"
    assert elsewhere.read_text().splitlines() == [
        "before",
        "<!-- table: movers -->",
        "| | t_rel | not trusted |",
        "|---|---|---|",
        "| one | 0.20 % | 3 |",
        "| other | 0.30 % |  |",
        "",
        f"<sub>`make results ONLY=movers`: {origin}</sub>",
        "<!-- end -->",
        "after",
    ]
    elsewhere.write_text(elsewhere.read_text().replace("0.20", "0.19"))
    assert results.outdated() == ["page.md"]


def test_what_is_not_measured_again_stays(results, elsewhere):
    earlier = {"movers": {**RECORD, "commit": "fedcba9"}}
    results.FILE.write_text(json.dumps(earlier))
    measure(results, "occupancy")
    assert json.loads(results.FILE.read_text()) == {**earlier, "occupancy": RECORD}


def test_a_table_without_its_data_is_skipped_and_says_why(results, elsewhere, monkeypatch, capsys):
    monkeypatch.delenv("RECON_DATA", raising=False)
    assert measure(results, "kitti-d", "middlebury") == 0
    assert capsys.readouterr().out.splitlines() == [
        "kitti-drift: skipped, RECON_DATA is not set",
        "middlebury: skipped, RECON_DATA is not set",
    ]
    assert not results.FILE.exists()


def test_a_table_that_fails_keeps_what_it_has(results, elsewhere, monkeypatch):
    def fail(name: str) -> None:
        raise LookupError(name)

    results.FILE.write_text(json.dumps({"movers": RECORD}))
    monkeypatch.setattr(results, "measured", fail)
    assert measure(results, "movers") == 1
    assert results.read() == {"movers": RECORD}
