"""This checkout beside another: drives mapped, the start of the program, the size of the code.

Both map each drive in turn, in processes of their own, so that other load affects both alike.
Ratios are this checkout's over the other's, of each round; it ends with 1 where processor time is
significantly above the limit. `--history` keeps what was measured, and writes it to docs/speed.md.

The other is a folder, or a commit, which is checked out and compiled in a temporary folder; by
default the last tag, or the commit before this one. Without RECON_DATA streets are rendered.

Example: python benchmarks/two_checkouts.py --other ../earlier --drive DRIVE --rounds 3
"""

from __future__ import annotations

import argparse
import ast
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import speed
from results import ROOT as HERE
from results import git, machine
from scipy.stats import t as student

REAL: Final = ("driven/kitti_raw_0013", "driven/kitti_06_51", "rooms/euroc_v1_sparse")
RENDERED: Final = ("curve", "block", "room")
CONFIDENCE: Final = 0.95
LEAST_RATIOS: Final = 3  # fewer say nothing of how much they spread
PAGE: Final = HERE / "docs" / "speed.md"
KEPT: Final = HERE / "docs" / "speed.json"
MARKS: Final = ("<!-- written by benchmarks/two_checkouts.py --history -->\n", "<!-- end -->\n")
Figures = dict[str, float]
Rounds = dict[str, dict[str, list[Figures]]]
"""Figures of each round, by drive and by checkout."""


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    if options.history:
        names = {"this": clean_commit(), "other": git("rev-parse", "--short=8", options.other)}
    with checkout_of(options.other) as other, drives_of(options.drive) as drives:
        checkouts = {"this": HERE, "other": other}
        units = [speed.stereo_bm_s()]
        found: Rounds = {str(drive): {"this": [], "other": []} for drive in drives}
        for number in range(options.rounds):
            # The one that goes first changes, as whatever it warms up serves the second.
            for drive in drives:
                for name in sorted(checkouts, reverse=bool(number % 2)):
                    found[str(drive)][name].append(run(checkouts[name], drive))
                units.append(speed.stereo_bm_s())
        unit_s = statistics.median(units)
        if options.history:
            more = {name: works(one, drives[0]) for name, one in checkouts.items()}
            keep(names, found[str(drives[0])], more, unit_s, drives[0].name)
        houses = {name: house(one) for name, one in checkouts.items()}
    slower = too_slow(found, options.limit)
    if options.json:
        print(json.dumps({"stereo_bm_s": unit_s, "rounds": found, "code": houses, "slow": slower}))
    else:
        print(table(found, houses, unit_s))
        print("\n".join(slower))
    sys.exit(int(bool(slower)))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--other", default=earlier(), help="another checkout, or a commit")
    parser.add_argument("--drive", type=Path, nargs="+", help="what `recon map` maps")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--limit", type=float, default=1.03, help="ratio that is too slow")
    parser.add_argument("--history", action="store_true", help="write both to docs/speed.md")
    parser.add_argument("--json", action="store_true")
    return parser.parse_args(arguments)


def earlier() -> str:
    """The last tag, or the commit before this one."""
    tags = git("tag", "--sort=-creatordate", "--merged", "HEAD").split()
    return tags[0] if tags else "HEAD~1"


def clean_commit() -> str:
    if git("status", "--porcelain", "--", "recon", "benchmarks"):
        sys.exit("commit the changes of recon/ and benchmarks/ first: the page names the commit")
    return git("rev-parse", "--short=8", "HEAD")


@contextmanager
def checkout_of(other: str) -> Iterator[Path]:
    """The folder of a checkout; that of a commit is compiled, and removed in the end."""
    if Path(other).is_dir():
        yield Path(other).resolve()
        return
    found = subprocess.run(
        ["git", "rev-parse", "--verify", "--quiet", f"{other}^{{commit}}"],
        cwd=HERE,
        capture_output=True,
        check=False,
    )
    if found.returncode:
        sys.exit(f"--other: got {other}, expected a folder or a commit of this repository")
    with tempfile.TemporaryDirectory() as folder:
        there = Path(folder) / "other"
        git("worktree", "add", "--detach", str(there), other)
        try:
            speed.called(there, "doctor", "--compile")
            yield there
        finally:
            git("worktree", "remove", "--force", str(there))


@contextmanager
def drives_of(given: Sequence[Path] | None) -> Iterator[list[Path]]:
    """The drives given, those of RECON_DATA, or rendered ones."""
    data = os.environ.get("RECON_DATA")
    real = [Path(data) / name for name in REAL] if data else []
    if given or (real and all(drive.is_dir() for drive in real)):
        yield list(given or real)
        return
    import altered_drives  # noqa: PLC0415 - it loads the library

    from recon.commands.config import load_config  # noqa: PLC0415
    from recon.commands.demo import demo_source  # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder:
        for shape in RENDERED:
            street = demo_source(load_config(None, [f"street.path={shape}"]))
            altered = altered_drives.alterations(street)["as it is"]
            altered_drives.write_kitti(altered, Path(folder) / shape)
        yield [Path(folder) / shape for shape in RENDERED]


def run(checkout: Path, drive: Path) -> Figures:
    """Map the drive once with the code of a checkout."""
    costs, summary = speed.mapped(checkout, drive)
    parts = {"first_frame": "before the first frame", "frame": "a frame", "run": "whole run"}
    return {
        **{f"{name}_s": costs[part].seconds for name, part in parts.items()},
        **{f"{name}_processor_s": costs[part].processor_s for name, part in parts.items()},
        "fps": float(summary["fps"]),
        "peak_memory_mb": float(summary["peak_memory_mb"]),
        "run_folder_mb": float(summary["run_folder_mb"]),
        "help_processor_s": speed.called(checkout, "--help").processor_s,
    }


def ratios(rounds: Mapping[str, Sequence[Figures]], key: str) -> list[float]:
    """This over the other in each round, where both are known."""
    each = zip(rounds["this"], rounds["other"], strict=True)
    return [this[key] / other[key] for this, other in each if other[key] > 0 and this[key] > 0]


def least_ratio(values: Sequence[float]) -> float:
    """The lower end of the confidence interval of a ratio, by the spread of some; 0 = unknown."""
    if len(values) < LEAST_RATIOS:
        return 0.0
    logs = [math.log(value) for value in values]
    error = statistics.stdev(logs) / math.sqrt(len(logs))
    return math.exp(statistics.mean(logs) - float(student.ppf(CONFIDENCE, len(logs) - 1)) * error)


def too_slow(found: Rounds, limit: float) -> list[str]:
    """What takes significantly more processor time than the limit: on a drive, and on all."""
    lines, pooled = [], dict[str, list[float]]()
    for drive, rounds in found.items():
        for key in (key for key in rounds["this"][0] if key.endswith("processor_s")):
            values = ratios(rounds, key)
            pooled.setdefault(key, []).extend(values)
            if least_ratio(values) > limit:
                lines.append(f"slower: {key} of {Path(drive).name}, {spread(values)}")
    every = [(key, values) for key, values in pooled.items() if least_ratio(values) > limit]
    return lines + [f"slower: {key} of all drives, {spread(values)}" for key, values in every]


def spread(values: Sequence[float]) -> str:
    """The median of some ratios, with the least and the most."""
    if not values:
        return "unknown"
    return f"{statistics.median(values):.3f} ({min(values):.3f} to {max(values):.3f})"


def table(found: Rounds, houses: dict[str, dict[str, Any]], unit_s: float) -> str:
    lines = [f"StereoBM {1e3 * unit_s:.1f} ms of a processor"]
    for drive, rounds in found.items():
        columns = ("this", "other", "StereoBM", "ratio (least to most)")
        lines += ["", f"{Path(drive).name:26}" + "".join(f"{name:>12}" for name in columns)]
        for key in rounds["this"][0]:
            this, other = (statistics.median(r[key] for r in rounds[n]) for n in ("this", "other"))
            units = f"{this / unit_s:12.1f}" if key.endswith("_s") else " " * 12
            ratio = spread(ratios(rounds, key))
            lines.append(f"{key:26}{this:12.4g}{other:12.4g}{units}   {ratio}")
    lines += ["", f"{'code':26}{'this':>12}{'other':>12}"]
    for key, value in houses["this"].items():
        lines.append(f"{key:26}{value:12}{houses['other'][key]:12}")
    return "\n".join(lines)


def works(checkout: Path, drive: Path) -> dict[str, Any]:
    """What else the page has of a checkout: a pair, and the drive while it arrives."""
    taken, arriving = speed.pair(checkout, drive), speed.live(checkout, drive)
    return {"pair": taken._asdict(), "live": arriving}


def keep(
    names: Mapping[str, str],
    rounds: Mapping[str, Sequence[Figures]],
    more: Mapping[str, dict[str, Any]],
    unit_s: float,
    drive: str,
) -> None:
    """Add the lines of two commits, in place of those measured together before; write the page."""
    together, kept = "+".join(names.values()), read()
    for name, commit in names.items():
        figures = {
            key: statistics.median(one[key] for one in rounds[name]) for key in rounds[name][0]
        }
        kept = [one for one in kept if (one["commit"], one["run"]) != (commit, together)]
        where = {"date": time.strftime("%Y-%m-%d"), "cpu": machine()["cpu"], "drive": drive}
        line = {"commit": commit, "run": together, "rounds": len(rounds[name]), **where}
        kept.append({**line, "stereo_bm_s": unit_s, **figures, **more[name]})
    KEPT.write_text(json.dumps(kept, indent=1) + "\n")
    before, after = PAGE.read_text().split(MARKS[0])[0], PAGE.read_text().split(MARKS[1])[-1]
    PAGE.write_text(before + MARKS[0] + page(kept) + MARKS[1] + after)


def read() -> list[dict[str, Any]]:
    return list(json.loads(KEPT.read_text())) if KEPT.is_file() else []


WORK: Final = {
    "`recon pair`, compiled": ("pair",),
    "before the first frame": ("first_frame_s", "first_frame_processor_s"),
    "a frame while mapping": ("frame_s", "frame_processor_s"),
    "whole run, with mesh and report": ("run_s", "run_processor_s"),
}


def page(kept: Sequence[dict[str, Any]]) -> str:
    """The tables of the page: one for each run of the benchmark, the last one first."""
    runs = dict.fromkeys(one["run"] for one in reversed(kept))
    return "\n".join(_beside([one for one in kept if one["run"] == run]) for run in runs)


def _beside(lines: Sequence[dict[str, Any]]) -> str:
    """A table of two commits that were measured in turn: work, and what it takes."""
    heads = [f"{one['commit']}: StereoBM | seconds | processor s" for one in lines]
    rows = [f"| work | {' | '.join(heads)} | ratio |", "|---" * (3 * len(lines) + 2) + "|"]
    for work, keys in WORK.items():
        found = [[*one["pair"].values()] if len(keys) == 1 else [one[k] for k in keys]
                 for one in lines]  # fmt: skip
        cells = [
            f"{seconds / one['stereo_bm_s']:.1f} | {seconds:.3g} | {processor_s:.3g}"
            for one, (seconds, processor_s) in zip(lines, found, strict=True)
        ]
        rows.append(f"| {work} | {' | '.join(cells)} | {found[0][1] / found[-1][1]:.2f} |")
    for name, key in (("median", "p50"), ("95 of 100", "p95")):
        late = [one["live"]["latency_ms"][key] for one in lines]
        cells = [f"{ms / 1e3 / one['stereo_bm_s']:.1f} | {ms / 1e3:.3f} |"
                 for one, ms in zip(lines, late, strict=True)]  # fmt: skip
        rows.append(f"| live, {name}: late by | {' | '.join(cells)} | {late[0] / late[-1]:.2f} |")
    one = lines[0]
    what = f"{one['drive']}, {one['date']}, {one['cpu']}, medians of {one['rounds']}"
    unit = f"StereoBM {1e3 * one['stereo_bm_s']:.0f} ms; the ratio is of processor time"
    each = [one["live"] for one in lines]
    missed = [one["frames_dropped"] + one["frames_not_matched"] for one in each]
    fitted = [str(live["frames_arrived"] - n) for live, n in zip(each, missed, strict=True)]
    matched = f"live matched {' and '.join(fitted)} of {each[0]['frames_arrived']} frames"
    return "\n".join([*rows, "", f"<sub>{what}; {unit}; {matched}</sub>", ""])


def house(checkout: Path) -> dict[str, Any]:
    """The size of the code of a checkout."""
    files = sorted((checkout / "recon").rglob("*.py"))
    trees = [ast.parse(path.read_text()) for path in files]
    classes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    folders = [path.parent for path in files]
    listed = subprocess.run(
        speed.command("settings", "--json"),
        **speed.inside(checkout),
        check=True,
        capture_output=True,
        text=True,
    )
    return {
        "lines": sum(len(path.read_text().splitlines()) for path in files),
        "files": len(files),
        "rooms": len(list((checkout / "recon").glob("*/__init__.py"))),
        "largest_folder_files": max(folders.count(folder) for folder in set(folders)),
        "classes": len(classes),
        "dataclasses": sum(
            "dataclass" in ast.unparse(decorator) for c in classes for decorator in c.decorator_list
        ),
        "settings": sum(len(group["settings"]) for group in json.loads(listed.stdout)["groups"]),
    }


if __name__ == "__main__":
    main()
