"""House rules that no linter checks."""

from __future__ import annotations

import ast
import re
import statistics
from pathlib import Path

import pytest

NO_NAMES = {"utils", "common", "helpers", "misc"}
MAX_LINES = 400
TEXT = {"", ".py", ".md", ".toml", ".txt", ".sh", ".yaml", ".yml", ".html", ".js", ".css"}
OURS = ("recon", "tests", "docs", "examples", "benchmarks", "scripts", ".ci")
MACHINE_PATH = re.compile(r"(?<![\w.])/(home|root|work|Users|opt|mnt)/\w")


def _text_files(root: Path) -> list[Path]:
    inside = [path for folder in OURS for path in (root / folder).rglob("*")]
    files = [path for path in [*inside, *root.iterdir()] if path.is_file()]
    return [path for path in files if path.suffix in TEXT and "__pycache__" not in path.parts]


@pytest.fixture(scope="module")
def functions(trees: dict[Path, ast.Module]) -> list[tuple[Path, ast.FunctionDef]]:
    """All functions of the library but those of kernels."""
    return [
        (path, node)
        for path, tree in trees.items()
        if "kernels" not in path.parts
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
    ]


def test_every_module_says_what_it_is(trees: dict[Path, ast.Module]) -> None:
    silent = [str(path) for path, tree in trees.items() if not ast.get_docstring(tree)]

    assert silent == []


def test_no_package_or_module_is_a_drawer_for_everything(trees: dict[Path, ast.Module]) -> None:
    names = {name for path in trees for name in (path.stem, path.parent.name)}

    assert names & NO_NAMES == set()


def test_a_name_is_imported_from_the_file_that_defines_it(
    trees: dict[Path, ast.Module], root: Path
) -> None:
    gathering = {
        path.parent.relative_to(root).as_posix()
        for path, tree in trees.items()
        if path.name == "__init__.py"
        and any(isinstance(node, ast.ImportFrom) for node in tree.body if not _of_future(node))
    }

    # `recon` loads its names on first use; `cli` is the program.
    assert gathering - {"recon", "recon/cli"} == {"recon/core/values"}


def _of_future(node: ast.stmt) -> bool:
    return isinstance(node, ast.ImportFrom) and node.module == "__future__"


def test_files_are_short(root: Path) -> None:
    lengths = {
        str(path.relative_to(root)): len(path.read_text().splitlines())
        for path in _text_files(root)
        if path.suffix == ".py"
    }

    assert {path: length for path, length in lengths.items() if length > MAX_LINES} == {}


def test_functions_are_short(functions: list[tuple[Path, ast.FunctionDef]]) -> None:
    """House style: half of all functions within 8 lines, 90 % within 30 (kernels apart)."""
    lengths = sorted(_body_lines(node) for _, node in functions)

    assert statistics.median(lengths) <= 8
    assert statistics.quantiles(lengths, n=10)[-1] <= 30


def _body_lines(function: ast.FunctionDef) -> int:
    body = function.body[1:] if ast.get_docstring(function) else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def test_no_file_names_a_path_of_one_machine(root: Path) -> None:
    found = [
        f"{path.relative_to(root)}:{number}: {line.strip()}"
        for path in _text_files(root)
        for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1)
        if MACHINE_PATH.search(line)
    ]

    assert found == []


@pytest.mark.parametrize("script", [".ci/run", "scripts/setup.sh"])
def test_script_can_be_executed(script: str, root: Path) -> None:
    assert (root / script).stat().st_mode & 0o111


THINGS = """
frame pair point place loop pose image position view inlier feature warning session drive scene
segment byte row face triangle voxel tile gap coefficient
"""


def test_numbers_of_things_are_written_by_one_function(root: Path) -> None:
    """So that none reads "1 frames"; constants, which are in capitals, are more than one."""
    plural = re.compile(
        rf"(\{{[^{{}}:]*[a-z][^{{}}:]*\}}+|%d) ({'|'.join(THINGS.split())})s\b(?! the)"
    )
    files = [*(root / "recon").rglob("*.py"), *(root / "recon").rglob("*.j2")]
    found = [
        f"{path.name}: {one[0]}" for path in files for one in plural.finditer(path.read_text())
    ]
    assert found == []
