"""Benchmarks run seldom, so what they import from the library is looked up here."""

from __future__ import annotations

import ast
from pathlib import Path


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
