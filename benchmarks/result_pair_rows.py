"""The rows of the tables of pairs: matchers on them, their confidence, and surfaces of them."""

from __future__ import annotations

import re
from statistics import fmean
from typing import Any

from result_drift_rows import Found, Rows


def middlebury(found: Found) -> Rows:
    rows: Rows = {}
    for size, columns in found.items():
        for name, one in columns["matchers"].items():
            dense = one["weighted"]["nonocc"]["dense"]
            bad = {f"bad {limit}": dense["bad"][limit] for limit in ("1", "2", "4")}
            rows[f"`{name}`{size}"] = {**bad, "mean error": dense["avgerr"]}
    return rows


#: Of `benchmarks/pairs.py`: columns and figures, in per cent.
PAIRS = {
    "bad 2 of all": "off by 2",
    "measured": "measured",
    "bad 2": "measured, off by 2",
    "inferred": "inferred",
    "off by 3": "inferred, off by 3",
    "of nothing: measured": "measured, in none",
    "inferred, too": "inferred, in none",
    "other side": "measured, other side",
}


def pairs(found: Found) -> Rows:
    """All scenes, filled and not, then each scene filled; the mean over the seeds of a scene."""
    scenes: dict[str, list[dict[str, Any]]] = {}
    for name, one in found[""]["scenes"].items():
        scenes.setdefault(re.sub(r" [01]$", "", name), []).append(one)
    every = [one for several in scenes.values() for one in several]
    rows = {f"all, {label}": pair_row([one[label] for one in every]) for label in every[0]}
    for name, several in scenes.items():
        for label in several[0]:
            if f"{label}, filled" not in several[0]:
                rows[f"{name}, {label}"] = pair_row([one[label] for one in several])
    return rows


def pair_row(several: list[dict[str, float | None]]) -> dict[str, Any]:
    """The cells of one matcher: the mean over scenes, of those that have the figure."""

    def over(key: str) -> float | None:
        known = [value for one in several if (value := one[key]) is not None]
        return fmean(known) if known else None

    eces = [over(f"{kind}, ece") for kind in ("measured", "inferred")]
    return {
        **{heading: over(key) for heading, key in PAIRS.items()},
        "ECE": " / ".join("" if each is None else f"{each:.2f}" for each in eces),
        "AUSE at steps": over("measured, ause at steps"),
        "seconds": over("seconds"),
    }


def confidence(found: Found) -> Rows:
    return {
        f"{folder}, `{name}`": {
            "calibration error": one["weighted"]["confidence"]["ece"],
            "AUSE": one["weighted"]["confidence"]["ause"],
            "within one sigma": 100 * one["weighted"]["confidence"]["within_1_sigma"],
            "within two": 100 * one["weighted"]["confidence"]["within_2_sigma"],
        }
        for folder, scenes in found.items()
        for name, one in scenes["matchers"].items()
    }


def pair_meshes(found: Found) -> Rows:
    return {
        f"{scene}, `{way}`": figures
        for scene, ways in found["scenes"].items()
        for way, figures in ways.items()
    }
