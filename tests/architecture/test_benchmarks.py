"""Benchmarks run seldom, so what they import from the library is looked up here."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest


def test_benchmarks_import_what_is_there(trees: dict[Path, ast.Module], root: Path) -> None:
    defined = {path: _defined(tree) for path, tree in trees.items()}
    missing = [
        f"{path.name}:{node.lineno} {node.module}.{name.name}"
        for path in sorted((root / "benchmarks").glob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("recon.")
        for name in node.names
        if name.name not in defined.get(_file(root, str(node.module)), ())
        and _file(root, f"{node.module}.{name.name}") not in defined
    ]

    assert missing == []


@pytest.mark.parametrize("child", [False, True])
def test_a_benchmark_measures_the_checkout_that_it_stands_in(
    root: Path, tmp_path: Path, child: bool
) -> None:
    other = tmp_path / "other" / "recon"
    other.mkdir(parents=True)
    (other / "__init__.py").write_text("raise SystemExit('another recon was imported')")
    starts_another = (
        "import checkout, subprocess, sys; "
        "sys.exit(subprocess.call([sys.executable, '-c', 'import recon; print(recon.__file__)']))"
    )
    if child:  # as when a benchmark of the folder runs, whose own place Python looks at first
        command, path = ["-c", starts_another], [root / "benchmarks", other.parent]
    else:
        command, path = [str(root / "benchmarks" / "map_store.py"), "--help"], [other.parent]
    done = subprocess.run(
        [sys.executable, *command],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (str(root / "recon" / "__init__.py") if child else "usage: map_store.py") in done.stdout


def test_every_benchmark_says_first_what_is_measured(root: Path) -> None:
    """What stands before the first import from the library decides from where that comes."""
    late = []
    for path in sorted((root / "benchmarks").glob("*.py")):
        tree = ast.parse(path.read_text()).body
        names = [n.names[0].name if isinstance(n, ast.Import) else str(n.module) for n in tree
                 if isinstance(n, ast.Import | ast.ImportFrom)]  # fmt: skip
        ours = [name.partition(".")[0] in {"recon", "tests"} for name in names]
        if any(ours) and "checkout" not in names[: ours.index(True)]:
            late.append(path.name)

    assert late == []


def _file(root: Path, module: str) -> Path:
    path = root.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _defined(tree: ast.Module) -> set[str]:
    """Names that a module defines or imports, at its top level."""
    stored = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and _is_stored(n)}
    made = {n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)}
    imports = (n for n in tree.body if isinstance(n, ast.ImportFrom | ast.Import))
    return stored | made | {a.asname or a.name for node in imports for a in node.names}


def _is_stored(name: ast.Name) -> bool:
    return isinstance(name.ctx, ast.Store)
