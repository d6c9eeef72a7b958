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


def test_every_table_is_measured_has_one_place_and_no_figures_are_typed_elsewhere(results):
    assert results.outdated() == []
    # Figures stand behind the first column: `| 12.3 % |`.
    pages = [page.read_text() for page in results.PAGES]
    places = [place[2] for text in pages for place in results.PLACE.finditer(text)]
    begun = [name for text in pages for name in re.findall("<!-- table: (.*) -->", text)]
    assert sorted(places) == sorted(begun) == sorted(results.TABLES)
    for text in pages:
        typed = results.PLACE.sub("", text)
        assert re.findall(r"^\|[^|\n]*\|.*?\d[.\d]* (?:%|m|ms|MB)\b.*$", typed, re.MULTILINE) == []


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


def test_a_table_that_fails_keeps_what_it_has(results, elsewhere, monkeypatch):
    def fail(name: str) -> None:
        raise LookupError(name)

    results.FILE.write_text(json.dumps({"movers": RECORD}))
    monkeypatch.setattr(results, "measured", fail)
    assert (measure(results, "movers"), results.read()) == (1, {"movers": RECORD})
