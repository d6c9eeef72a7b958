"""Fixtures for tests of the project's own files."""

import ast
import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


@pytest.fixture(scope="session")
def root():
    return Path(__file__).parents[2]


@pytest.fixture(scope="session")
def pyproject(root):
    return tomllib.loads((root / "pyproject.toml").read_text())


@pytest.fixture(scope="session")
def trees(root):
    modules = sorted((root / "recon").rglob("*.py"))
    return {path: ast.parse(path.read_text()) for path in modules}
