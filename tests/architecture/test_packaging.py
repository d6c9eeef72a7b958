"""The package declares exactly the dependencies it uses."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest

import recon

# What numba takes from scipy: it is compiled without, and fails when it is called.
FROM_SCIPY = {"linalg", "dot", "vdot", "matmul", "tensordot", "roots", "cov", "corrcoef"}


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", re.split(r"[\[<>=!~; ]", name)[0]).lower()


@pytest.fixture(scope="module")
def imported(trees: dict[Path, ast.Module]) -> dict[str, set[str]]:
    """Names of the libraries that are imported, with the names that they could be declared by."""
    names = set()
    for tree in trees.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.add(node.module.split(".")[0])
    providers = packages_distributions()
    return {
        name: {_normal(provider) for provider in providers.get(name, [name])}
        for name in names - set(sys.stdlib_module_names) - {"recon"}
    }


def _declared(pyproject: dict[str, Any]) -> set[str]:
    return {_normal(entry) for entry in pyproject["project"]["dependencies"]}


def test_every_imported_library_is_declared(
    imported: dict[str, set[str]], pyproject: dict[str, Any]
) -> None:
    declared = _declared(pyproject)

    assert {name for name, providers in imported.items() if not declared & providers} == set()


def test_every_declared_library_is_imported(
    imported: dict[str, set[str]], pyproject: dict[str, Any]
) -> None:
    assert _declared(pyproject) - set().union(*imported.values()) == set()


def test_every_optional_library_is_declared_by_the_extra_that_its_error_names(
    trees: dict[Path, ast.Module], pyproject: dict[str, Any]
) -> None:
    extras = pyproject["project"]["optional-dependencies"]
    asked = {pair for tree in trees.values() for pair in _required(tree)}
    providers = packages_distributions()

    assert {extra for _, extra in asked} == set(extras) - {"dev"}
    for library, extra in asked:
        # "dask[distributed]" brings dask and distributed.
        declared = {name for entry in extras[extra] for name in re.findall(r"[\w-]+", entry)}
        assert declared & {_normal(name) for name in providers[library]}, (library, extra)


def _required(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Library and extra of each call of `recon.core.errors.require`."""
    texts = {
        node.target.id if isinstance(node, ast.AnnAssign) else node.targets[0].id: node.value.value
        for node in tree.body
        if isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(node.value, ast.Constant)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "require":
            extra = node.keywords[0].value
            name = extra.value if isinstance(extra, ast.Constant) else texts[extra.id]
            if isinstance(node.args[0], ast.Constant):
                yield node.args[0].value.split(".")[0], name


def test_kernels_need_no_linear_algebra_of_scipy(trees: dict[Path, ast.Module]) -> None:
    found = [
        f"{path.name}:{node.lineno}"
        for path, tree in trees.items()
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef) and _is_compiled(function)
        for node in ast.walk(function)
        if (isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult))
        or (isinstance(node, ast.Attribute) and node.attr in FROM_SCIPY)
    ]

    assert found == []


def _is_compiled(function: ast.FunctionDef) -> bool:
    """Whether a function is decorated with `kernel`, with options or without."""
    names = {ast.unparse(getattr(mark, "func", mark)) for mark in function.decorator_list}
    return "kernel" in names


def test_constraints_pin_every_declared_library(root: Path, pyproject: dict[str, Any]) -> None:
    lines = (root / "constraints.txt").read_text().splitlines()
    pinned = {_normal(line) for line in lines if "==" in line and not line.startswith("#")}
    wanted = _declared(pyproject) | {
        _normal(entry) for entry in pyproject["project"]["optional-dependencies"]["dev"]
    }

    assert wanted - pinned == set()


def test_version_is_the_same_everywhere(root: Path, pyproject: dict[str, Any]) -> None:
    version = pyproject["project"]["version"]

    assert recon.__version__ == version
    assert f"## [{version}]" in (root / "CHANGELOG.md").read_text()
