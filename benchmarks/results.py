"""Measures the tables of README and docs/results.md, and writes them into the pages.

What a table is made of stands in `result_tables.py`. What was measured goes to docs/results.json:
for each table its commands, commit, date and machine, so that tables of several commits stand side
by side. Tables that need data which is not there are skipped, and keep what they have.

Examples:
    python benchmarks/results.py --only movers kitti
    python benchmarks/results.py --check
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from result_commands import Table
from result_tables import TABLES
from tuned_on import LEGEND, mark

ROOT: Final = Path(__file__).resolve().parents[1]
FILE: Final = ROOT / "docs" / "results.json"
PAGES: Final = (ROOT / "README.md", ROOT / "docs" / "results.md")
PLACE: Final = re.compile(r"(<!-- table: ([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
"""Where a page has a table."""

VERSIONS: Final = ("numpy", "numba", "opencv-python-headless", "open3d", "kiss-icp")
FEATURES: Final = ("sse4_2", "avx2", "fma", "avx512f", "avx512_vnni")
Record = dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    if options.check:
        sys.exit("\n".join(f"{page} differs: make results ONLY=none" for page in outdated()) or 0)
    failed = False
    for name in chosen(options.only):
        lacking = TABLES[name].lacking()
        if lacking:
            print(f"{name}: skipped, {lacking}", flush=True)
            continue
        try:
            keep(name, measured(name))
        except (subprocess.CalledProcessError, LookupError, ValueError) as error:
            print(f"{name}: failed, keeps what it has: {error!r}", file=sys.stderr, flush=True)
            failed = True
    for page in outdated():
        (ROOT / page).write_text(rendered(ROOT / page))
    sys.exit(int(failed))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--only", nargs="+", help=f"tables, or how their names begin; none: {', '.join(TABLES)}"
    )
    parser.add_argument("--check", action="store_true", help="only say which page differs")
    return parser.parse_args(arguments)


def chosen(only: Sequence[str] | None) -> list[str]:
    """Names of the tables to measure; all by default."""
    if only is None:
        return list(TABLES)
    unknown = [name for name in only if name != "none" and not matching(name)]
    if unknown:
        sys.exit(f"no table {', '.join(unknown)}; there are {', '.join(TABLES)}")
    return [name for name in TABLES if any(name in matching(each) for each in only)]


def matching(beginning: str) -> list[str]:
    return [name for name in TABLES if name.startswith(beginning)]


def measured(name: str) -> Record:
    """Run the commands of a table; what they found, and where."""
    table, load = TABLES[name], os.getloadavg()[0]
    commit, date = commit_here(), time.strftime("%Y-%m-%d")
    with tempfile.TemporaryDirectory() as folder:
        found = {key: output(line, Path(folder)) for key, line in table.commands.items()}
    return {
        "commands": list(table.commands.values()),
        "commit": commit,
        "date": date,
        "machine": machine(),
        "load": round(load, 1),
        "timed": table.timed,
        "columns": table.columns,
        "rows": rows_of(table, found),
    }


def rows_of(table: Table, found: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The cells of a table, with as many digits as its columns show."""
    return {
        label: {
            column: shown(table.columns[column], value)
            for column, value in row.items()
            if value is not None
        }
        for label, row in table.rows(found).items()
    }


def shown(form: str, value: Any) -> Any:
    digits = re.search(r"\.(\d)f", form)
    return round(value, int(digits[1])) if digits and isinstance(value, float) else value


def output(line: str, folder: Path) -> Any:
    """Run a line, or remember what it printed: several tables share those that write no files."""
    return run_here(line, folder) if "$OUT" in line else run_once(line)


@cache
def run_once(line: str) -> Any:
    return run_here(line, Path())


def run_here(line: str, folder: Path) -> Any:
    """Run a line in this clone; the JSON that its last command prints.

    Raises:
        subprocess.CalledProcessError: A command failed; what it said is printed.
    """
    print(f"$ {line}", flush=True)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    printed = "null"
    for command in line.split(" && "):
        words = [os.path.expandvars(word) for word in shlex.split(command)]
        program = {"recon": [sys.executable, "-m", "recon"], "python": [sys.executable]}[words[0]]
        done = subprocess.run(
            [*program, *(word.replace("$OUT", str(folder)) for word in words[1:])],
            cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            print(done.stderr[-2000:], file=sys.stderr)
            done.check_returncode()
        printed = done.stdout
    return json.loads(printed)


def commit_here() -> str:
    """The commit of this clone; what is measured must be in it."""
    if git("status", "--porcelain", "--", "recon", "benchmarks"):
        sys.exit("commit the changes of recon/ and benchmarks/ first: a table names its commit")
    return git("rev-parse", "--short=7", "HEAD")


def git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def machine() -> Record:
    """Processor, cores, memory, and the versions of what affects results."""
    from llvmlite.binding import get_host_cpu_name  # noqa: PLC0415 - not needed to render

    facts = Path("/proc/cpuinfo").read_text()
    model, flags = (
        re.search(rf"^{name}\s*: (.*)$", facts, re.MULTILINE) for name in ("model name", "flags")
    )
    has = flags[1].split() if flags else []
    return {
        "cpu": f"{model[1] if model else 'unknown'} ({get_host_cpu_name()})",
        "features": [feature for feature in FEATURES if feature in has],
        "cores": len(os.sched_getaffinity(0)),
        "python": ".".join(map(str, sys.version_info[:3])),
        **{package: version(package) for package in VERSIONS},
    }


def keep(name: str, record: Record) -> None:
    """Write one table to the file; the others stay."""
    tables = read() | {name: record}
    order = {name: tables[name] for name in TABLES if name in tables}
    FILE.write_text(json.dumps(order, indent=1, ensure_ascii=False) + "\n")


def read() -> dict[str, Record]:
    """What was measured, by table."""
    return dict(json.loads(FILE.read_text())) if FILE.exists() else {}


def outdated() -> list[str]:
    """Pages whose tables are not those of the file."""
    return [
        page.relative_to(ROOT).as_posix() for page in PAGES if page.read_text() != rendered(page)
    ]


def rendered(page: Path) -> str:
    """The text of a page with its tables as in the file."""
    tables = read()
    return PLACE.sub(
        lambda place: place[1] + "\n".join(lines(place[2], tables.get(place[2]))) + "\n" + place[3],
        page.read_text(),
    )


def lines(name: str, record: Record | None) -> Iterator[str]:
    """A table in Markdown, and where it is from."""
    how = f"`make results ONLY={name}`"
    if record is None:
        yield f"Not measured yet: {how}"
        return
    columns = record["columns"]
    yield f"| | {' | '.join(columns)} |"
    yield "|---" * (len(columns) + 1) + "|"
    scenes = TABLES[name].scenes if name in TABLES else ""
    marks = {label: mark(label, scenes) for label in record["rows"]}
    for label, row in record["rows"].items():
        cells = (columns[c].format(row[c]) if c in row else "" for c in columns)
        yield f"| {label}{marks[label]} | {' | '.join(cells)} |"
    machine = record["machine"]
    where = [f"commit {record['commit']}", record["date"], machine["cpu"]]
    where += [f"{machine['cores']} cores"]
    where += (
        [f"load {record['load']:g} at the start"] if record["timed"] and "load" in record else []
    )
    where += [record["note"]] if "note" in record else []
    where += [LEGEND] if any(marks.values()) else []
    yield ""
    yield f"<sub>{how}: {', '.join(where)}</sub>"


if __name__ == "__main__":
    main()
