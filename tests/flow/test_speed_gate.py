"""The speed gate fails where processor time has grown by more than its spread, and only there."""

import json

import numpy as np
import pytest

from tests.flow.runs import ROOT
from tests.scenery.kitti import street_drive

KEYS = ("run_processor_s", "frame_processor_s")


@pytest.fixture(scope="module")
def gate():
    """The benchmark as a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "benchmarks")
        import two_checkouts

        yield two_checkouts


def rounds_of(*ratios: float) -> dict:
    other = [dict.fromkeys(KEYS, 10.0) for _ in ratios]
    return {"this": [dict.fromkeys(KEYS, 10 * ratio) for ratio in ratios], "other": other}


def test_what_is_slower_in_all_rounds_is_slower(gate):
    lines = gate.too_slow({"a/town": rounds_of(1.1, 1.12, 1.09)}, 1.03)
    assert [line.split(",")[0] for line in lines] == [
        f"slower: {key} of {where}" for where in ("town", "all drives") for key in KEYS
    ]
    assert "1.100 (1.090 to 1.120)" in lines[0]


@pytest.mark.parametrize(
    "ratios",
    [(1.0, 1.01, 0.99), (0.5, 0.6, 0.55), (1.4, 0.8, 1.0), (1.02, 1.02, 1.02), (2.0, 2.0)],
    ids=["as fast", "faster", "spread", "within the limit", "too few rounds"],
)
def test_what_is_not_surely_slower_passes(gate, ratios):
    assert gate.too_slow({"town": rounds_of(*ratios)}, 1.03) == []


def test_one_round_of_three_drives_tells_what_is_slower_on_all(gate):
    found = {name: rounds_of(ratio) for name, ratio in (("a", 1.2), ("b", 1.25), ("c", 1.3))}
    assert [line.split(",")[0] for line in gate.too_slow(found, 1.03)] == [
        f"slower: {key} of all drives" for key in KEYS
    ]


def test_noise_alone_rarely_fails(gate):
    rng = np.random.default_rng(0)
    draws = np.exp(rng.normal(0, 0.05, (2000, 5)))
    failed = sum(gate.least_ratio(ratios) > 1.0 for ratios in draws)
    # One in twenty by the confidence; five standard deviations of a binomial around it.
    assert abs(failed - 100) < 5 * np.sqrt(100 * 0.95)


def test_a_run_keeps_one_line_for_each_commit_and_the_page_shows_both(gate, tmp_path, monkeypatch):
    page = tmp_path / "speed.md"
    page.write_text(f"before\n{gate.MARKS[0]}{gate.MARKS[1]}after\n")
    monkeypatch.setattr(gate, "PAGE", page)
    monkeypatch.setattr(gate, "KEPT", tmp_path / "speed.json")
    parts = ("first_frame_s", "frame_s", "run_s")
    figures = dict.fromkeys([*parts, *(f"{part[:-2]}_processor_s" for part in parts)], 2.0)
    cost = {"seconds": 3.0, "processor_s": 2.5}
    live = {"frames_arrived": 144, "frames_dropped": 0, "frames_not_matched": 54}
    more = {"pair": cost, "live": {**live, "latency_ms": {"p50": 50.0, "p95": 100.0}}}
    for unit_s in (0.05, 0.04):
        gate.keep(
            {"this": "2222222", "other": "1111111"},
            {"this": [figures], "other": [{**figures, "run_processor_s": 4.0}]},
            {"this": more, "other": more},
            unit_s,
            "town",
        )
    kept = json.loads((tmp_path / "speed.json").read_text())
    assert [(one["commit"], one["stereo_bm_s"]) for one in kept] == [
        ("2222222", 0.04),
        ("1111111", 0.04),
    ]
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "| whole run, with mesh and report | 50.0 | 2 | 2 | 50.0 | 2 | 4 | 0.50 |" in text
    assert "| live, 95 of 100: late by | 2.5 | 0.100 | | 2.5 | 0.100 | | 1.00 |" in text
    assert "live matched 90 and 90 of 144 frames" in text


@pytest.mark.slow
def test_a_checkout_beside_itself_is_as_fast(gate, tmp_path, capsys):
    drive = street_drive(tmp_path / "town", 4, speed_m_per_frame=0.4)
    command = ["--other", str(ROOT), "--drive", str(drive), "--rounds", "1", "--json"]
    with pytest.raises(SystemExit) as ended:
        gate.main(command)
    found = json.loads(capsys.readouterr().out)
    assert ended.value.code == 0
    assert found["slow"] == []
    for figures in (*found["rounds"][str(drive)]["this"], *found["rounds"][str(drive)]["other"]):
        assert 0 < figures["frame_processor_s"] < figures["run_processor_s"]
        assert 0 < figures["first_frame_s"] < figures["run_s"]
    assert 0 < found["stereo_bm_s"] < 1
    assert found["code"]["this"] == found["code"]["other"]


def test_what_is_no_commit_is_refused_in_one_line(gate):
    with pytest.raises(SystemExit, match="got nonsense, expected a folder or a commit"):
        gate.checkout_of("nonsense").__enter__()
