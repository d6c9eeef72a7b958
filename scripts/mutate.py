#!/usr/bin/env python3
"""Change one token at random, run the tests of that room, and count how many changes they notice.

Outside kernels an operator, a comparison (into its opposite), `and`, `or`, `not`, a number (by one)
or the condition of an `if` (into its opposite) is changed, or a value is not returned: in a copy of
the project, so the checkout stays as it is. What no test notices is printed.

    scripts/mutate.py --count 100 --seed 1
    scripts/mutate.py --room io core map/store --count 60
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).parents[1]
TESTS: Final = {"commands": ("commands", "flow"), "rig": ("rig", "commands")}
"""Rooms whose tests are in other folders than their own, too."""
OTHER: Final[dict[type[ast.AST], tuple[str, str]]] = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
    ast.Not: ("not ", ""),
    ast.USub: ("-", ""),
}
MAX_S: Final = 900
"""A change after which the tests do not end is noticed."""


@dataclass(frozen=True)
class Change:
    """One token of a file, by its line and its offset in the file's bytes."""

    path: Path
    line: int
    start: int
    old: str
    new: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.old.strip()!r} -> {self.new.strip()!r}"


def changes_of(path: Path) -> Iterator[Change]:
    """Yield the changes that can be made to a file, annotations aside."""
    text = (ROOT / path).read_bytes()
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    tree = ast.parse(text)
    hints = {id(part) for hint in _annotations(tree) for part in ast.walk(hint)}
    for node in ast.walk(tree):
        if id(node) in hints:
            continue
        yield from _rewritten(path, text, starts, node)
        for op, begin, end in _operators(node):
            old, new = OTHER.get(type(op), ("", ""))
            first = starts[begin[0] - 1] + begin[1]
            at = text.find(old.encode(), first, starts[end[0] - 1] + end[1]) if old else -1
            if at >= 0:
                yield Change(path, text.count(b"\n", 0, at) + 1, at, old, new)


def _rewritten(path: Path, text: bytes, starts: list[int], node: ast.AST) -> Iterator[Change]:
    """Yield what becomes of a number, of the condition of an `if` and of a returned value."""
    form = "{}"
    part: ast.expr | None = None
    if isinstance(node, ast.Constant) and type(node.value) in {int, float}:
        form, part = "({} + 1)", node
    elif isinstance(node, ast.If | ast.IfExp):
        form, part = "(not ({}))", node.test
    elif isinstance(node, ast.Return) and not isinstance(node.value, ast.Constant | None):
        form, part = "None", node.value
    if part is not None:
        begin, end = _begin(part), _end(part)
        first, last = starts[begin[0] - 1] + begin[1], starts[end[0] - 1] + end[1]
        old = text[first:last].decode()
        yield Change(path, begin[0], first, old, form.format(old))


def _annotations(tree: ast.AST) -> Iterator[ast.AST]:
    for node in ast.walk(tree):
        for name in ("annotation", "returns"):
            hint = getattr(node, name, None)
            if isinstance(hint, ast.AST):
                yield hint


def _operators(node: ast.AST) -> Iterator[tuple[ast.AST, tuple[int, int], tuple[int, int]]]:
    """Yield operators with the places, line and column, between which they are written."""
    if isinstance(node, ast.BinOp):
        yield node.op, _end(node.left), _begin(node.right)
    elif isinstance(node, ast.Compare):
        sides = [node.left, *node.comparators]
        for op, left, right in zip(node.ops, sides[:-1], sides[1:], strict=True):
            yield op, _end(left), _begin(right)
    elif isinstance(node, ast.BoolOp):
        yield node.op, _end(node.values[0]), _begin(node.values[1])
    elif isinstance(node, ast.UnaryOp):
        yield node.op, _begin(node), _begin(node.operand)
    elif isinstance(node, ast.AugAssign):
        yield node.op, _end(node.target), _begin(node.value)


def _begin(node: ast.AST) -> tuple[int, int]:
    return node.lineno, node.col_offset  # type: ignore[attr-defined]


def _end(node: ast.AST) -> tuple[int, int]:
    return node.end_lineno, node.end_col_offset  # type: ignore[attr-defined]


def choose(rooms: list[str], count: int, seed: int) -> list[Change]:
    """Choose changes, each with the same chance."""
    files = sorted({path for room in rooms for path in (ROOT / "recon" / room).rglob("*.py")})
    inside = [path.relative_to(ROOT) for path in files if "kernels" not in path.parts]
    every = [change for path in inside for change in changes_of(path)]
    return random.Random(seed).sample(every, min(count, len(every)))


def tests_of(change: Change) -> list[str]:
    """Return the test files that name the changed module, of any room, then the others of its."""
    room = change.path.parts[1]
    folders = TESTS.get(room, (room,))
    module = ".".join(change.path.with_suffix("").parts)
    every = sorted((ROOT / "tests").rglob("test_*.py"))
    naming = [path for path in every if module in path.read_text()]
    near = [path for path in every if path.relative_to(ROOT).parts[1] in folders]
    return [str(path.relative_to(ROOT)) for path in dict.fromkeys([*naming, *near])]


def notices(change: Change, copy: Path) -> bool:
    """Run the tests of a room on a copy of the project in which one token is changed."""
    path = copy / change.path
    text, stat = path.read_bytes(), path.stat()
    end = change.start + len(change.old.encode())
    path.write_bytes(text[: change.start] + change.new.encode() + text[end:])
    # Byte code of a file is recognised by its time in whole seconds.
    os.utime(path, (stat.st_atime, stat.st_mtime + 60))
    pytest = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    marks = ["-m", "not slow", "--timeout", "120"]
    surroundings = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        ran = subprocess.run(
            [*pytest, *marks, *tests_of(change)],
            cwd=copy,
            env=surroundings,
            capture_output=True,
            timeout=MAX_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return True
    finally:
        path.write_bytes(text)
        os.utime(path, (stat.st_atime, stat.st_mtime))
    return ran.returncode != 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--room", nargs="+", default=[""], help="folders of recon/; all by default")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    unseen: list[str] = []
    chosen = choose(options.room, options.count, options.seed)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "project"
        skipped = shutil.ignore_patterns(".git", ".venv", "outputs", ".*_cache")
        shutil.copytree(ROOT, copy, ignore=skipped)
        for change in chosen:
            noticed = notices(change, copy)
            unseen += [] if noticed else [str(change)]
            print("noticed  " if noticed else "UNNOTICED", change, file=sys.stderr, flush=True)
    seen = len(chosen) - len(unseen)
    figures: dict[str, Any] = {"changes": len(chosen), "noticed": seen, "unnoticed": unseen}
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
