"""What every command shares: configuration, report, summary and record of a run."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from recon.core.settings import Settings
from recon.run.progress import Silent
from recon.run.run import Run


class _Size(Settings):
    voxel_m: float = 0.1


class _Notes(Silent):
    def __init__(self) -> None:
        self.stages: list[str] = []

    def on_stage(self, name: str) -> None:
        self.stages.append(name)


def _read(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text())
    return content


def test_a_run_writes_configuration_summary_and_record(tmp_path: Path) -> None:
    photo = tmp_path / "im0.png"
    photo.write_bytes(b"pixels")
    notes = _Notes()
    summary: dict[str, Any] = {"points": 3, "warnings": ["few points"]}
    with Run("pair", tmp_path / "out", _Size(), threads=1, progress=notes) as run:
        with run.stage("match"):
            pass
        with run.report(summary):
            assert yaml.safe_load(run.path("config.yaml").read_text()) == {"voxel_m": 0.1}
            shown = dict(summary)
            run.path("report.html").write_text("<p>")
        run.finish(summary, source="im0", inputs=[photo], record={"mapped_by": "demo"})

    assert notes.stages == ["report"]
    assert _read(tmp_path / "out" / "summary.json") == summary
    assert summary["out"] == str(tmp_path / "out")
    assert list(shown) == ["points", "warnings", "seconds", "stages", "peak_memory_mb"]
    assert list(shown["stages"]) == ["match"]
    record = _read(tmp_path / "out" / "run.json")
    assert list(record["timings"]) == ["match", "report", "hash"]
    assert record["command"] == "pair"
    assert record["source"] == "im0"
    assert record["inputs"]["files"] == 1
    assert record["warnings"] == ["few points"]
    assert record["mapped_by"] == "demo"
    assert record["files"] == ["config.yaml", "report.html", "summary.json", "run.json"]


def test_report_summary_and_record_have_one_cost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    peak_mb = itertools.count(100.0)
    monkeypatch.setattr("recon.run.run.peak_memory_mb", lambda: next(peak_mb))
    summary: dict[str, Any] = {}
    with Run("pair", tmp_path / "out") as run:
        with run.report(summary):
            shown = dict(summary)
        run.finish(summary, source="im0", inputs=[])
    assert shown == {key: summary[key] for key in ("seconds", "stages", "peak_memory_mb")}
    assert _read(tmp_path / "out" / "run.json")["peak_memory_mb"] == shown["peak_memory_mb"]


def test_a_run_without_configuration_writes_none(tmp_path: Path) -> None:
    with Run("audit", tmp_path / "out") as run:
        run.finish({}, source="drive", inputs=[])
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "run.json",
        "summary.json",
    ]
