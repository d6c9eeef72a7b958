"""What every command shares: configuration, report, summary and record of a run."""

from __future__ import annotations

import itertools
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from recon.core.settings import Settings
from recon.run.progress import Silent
from recon.run.run import Run, fingerprint, plain


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


def test_a_run_writes_configuration_summary_and_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo, peak_mb = tmp_path / "im0.png", itertools.count(100.0)
    photo.write_bytes(b"pixels")
    monkeypatch.setattr("recon.run.run.peak_memory_mb", lambda: next(peak_mb))
    notes = _Notes()
    summary: dict[str, Any] = {"points": 3, "warnings": ["few points"]}
    with Run("pair", tmp_path / "out", _Size(), threads=1, progress=notes) as run:
        for _ in range(2):
            with run.stage("match"):
                time.sleep(0.01)
        with run.report(summary):
            assert yaml.safe_load(run.path("config.yaml").read_text()) == {"voxel_m": 0.1}
            shown = dict(summary)
            run.path("report.html").write_text("<p>")
        run.finish(summary, source="im0", inputs=[photo], record={"mapped_by": "demo"})

    assert notes.stages == ["report"]
    assert _read(tmp_path / "out" / "summary.json") == summary
    assert summary["out"] == str(tmp_path / "out")
    cost = ("seconds", "stages", "peak_memory_mb")
    assert list(shown) == ["points", "warnings", *cost]
    assert shown == {**{key: summary[key] for key in cost}, "points": 3, "warnings": ["few points"]}
    assert list(shown["stages"]) == ["match"]
    assert 60 > shown["seconds"] >= shown["stages"]["match"] >= 0.02
    record = _read(tmp_path / "out" / "run.json")
    assert list(record["timings"]) == ["match", "report", "hash"]
    kept = ("command", "source", "inputs", "warnings", "mapped_by", "peak_memory_mb", "files")
    assert {name: record[name] for name in kept} == {
        "command": "pair",
        "source": "im0",
        "inputs": fingerprint([photo]),
        "warnings": ["few points"],
        "mapped_by": "demo",
        "peak_memory_mb": shown["peak_memory_mb"],
        "files": ["config.yaml", "report.html", "summary.json", "run.json"],
    }


def test_a_run_without_configuration_writes_none(tmp_path: Path) -> None:
    with Run("audit", tmp_path / "out") as run:
        run.finish({}, source="drive", inputs=[])
    written = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert written == ["run.json", "summary.json"]


def test_a_hash_of_inputs_knows_their_names_bytes_and_order(tmp_path: Path) -> None:
    one, other = tmp_path / "one", tmp_path / "other"
    one.write_bytes(b"a" * 3_000_000)
    other.write_bytes(b"b")
    found = fingerprint([one, other])
    assert (found["files"], found["bytes"]) == (2, 3_000_001)
    hashes = {found["sha256"], fingerprint([other, one])["sha256"]}
    heads = fingerprint([one, other], head_bytes=4)
    one.write_bytes(b"a" * 2_999_999 + b"b")
    assert fingerprint([one, other], head_bytes=4) == heads
    hashes.add(fingerprint([one, other])["sha256"])
    one.rename(tmp_path / "renamed")
    hashes.add(fingerprint([tmp_path / "renamed", other])["sha256"])
    assert len(hashes) == 4


@dataclass(frozen=True)
class _Figures:
    error: float
    bad: dict[float, float]
    lengths: tuple[float, ...]


def test_plain_values_survive_json_and_nan_becomes_null() -> None:
    figures = _Figures(error=math.nan, bad={0.5: 1.25, 2.0: math.inf}, lengths=(50.0, 100.0))
    expected = {"error": None, "bad": {"0.5": 1.25, "2.0": None}, "lengths": [50.0, 100.0]}
    assert json.loads(json.dumps(plain(figures), allow_nan=False)) == expected
