"""The package declares exactly the dependencies it uses."""

from __future__ import annotations

import ast
import re
import sys
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest

import recon


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
