"""What people see of a batch that has ended."""

from __future__ import annotations

from typing import Any

import pytest

from recon.cli.show.tables import print_batch


def job(name: str, state: str = "succeeded", **more: Any) -> dict[str, Any]:
    return {"name": name, "state": state, "tries": 1, "seconds": 12.34, "figures": {}, **more}


def test_the_table_has_the_accuracy_of_each_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    jobs = [
        job("drive_window=9", figures={"trajectory.t_rel_percent": 0.512345, "points": 7.0}),
        job("pair_window=9", figures={"disparity.bad.2.0": 6.5, "points": 7.0}, remark="odd"),
        job("nowhere", "failed", error="there is no such folder"),
    ]
    print_batch({"jobs": jobs, "out": "outputs/week"})
    out, err = capsys.readouterr()
    for word in ("trajectory t", "disparity bad", "0.5123", "6.5", "drive_window=9"):
        assert word in out
    assert "points" not in out
    assert "unusual: pair_window=9: odd" in out
    assert err == "error: nowhere: there is no such folder\n"
    assert max(map(len, out.splitlines())) <= 80


def test_of_very_many_jobs_the_first_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    print_batch({"jobs": [job(f"j{n}") for n in range(1000)], "out": "outputs/week"})
    out = capsys.readouterr().out
    assert "j199 " in out
    assert "j200 " not in out
    assert "and 800 more, in table.csv" in out
