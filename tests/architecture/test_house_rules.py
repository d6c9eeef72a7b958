"""House rules of library, pages and benchmarks, and the linters themselves."""

import ast
import os
import re
import statistics
import subprocess
import sys
from pathlib import Path

import grimp
import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

NO_NAMES = {"utils", "common", "helpers", "misc"}
MAX_LINES = (500, 600)  # of a file; of one with tests
TEXT = {"", ".py", ".md", ".toml", ".txt", ".sh", ".yaml", ".yml", ".html", ".js", ".css"}
OURS = ("recon", "tests", "docs", "examples", "benchmarks", "scripts", ".ci")
MACHINE_PATH = re.compile(r"(?<![\w.])/(home|root|work|Users|opt|mnt)/\w")


def _text_files(root: Path) -> list[Path]:
    inside = [path for folder in OURS for path in (root / folder).rglob("*")]
    files = [path for path in [*inside, *root.iterdir()] if path.is_file()]
    return [path for path in files if path.suffix in TEXT and "__pycache__" not in path.parts]


def test_every_module_says_what_it_is_and_is_no_drawer(trees):
    assert [str(path) for path, tree in trees.items() if not ast.get_docstring(tree)] == []
    assert {name for path in trees for name in (path.stem, path.parent.name)} & NO_NAMES == set()


def test_a_name_is_imported_from_the_file_that_defines_it(trees, root):
    gathering = {
        path.parent.relative_to(root).as_posix()
        for path, tree in trees.items()
        if path.name == "__init__.py"
        and any(isinstance(n, ast.ImportFrom) and n.module != "__future__" for n in tree.body)
    }
    # `recon` loads its names on first use; `cli` is the program.
    assert gathering - {"recon", "recon/cli"} == {"recon/core/values"}


def test_files_are_short(root):
    lengths = {
        path.relative_to(root): len(path.read_text().splitlines())
        for path in _text_files(root)
        if path.suffix == ".py"
    }
    assert {path: n for path, n in lengths.items() if n > MAX_LINES[path.parts[0] == "tests"]} == {}


def test_functions_are_short(trees):
    """House style: nine of ten functions within 40 lines (kernels apart)."""
    modules = [tree for path, tree in trees.items() if "kernels" not in path.parts]
    nodes = [node for tree in modules for node in ast.walk(tree)]
    lengths = [_body_lines(node) for node in nodes if isinstance(node, ast.FunctionDef)]
    assert statistics.quantiles(lengths, n=10)[-1] <= 40


def _body_lines(function: ast.FunctionDef) -> int:
    body = function.body[1:] if ast.get_docstring(function) else function.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def test_no_file_names_a_path_of_one_machine(root):
    found = [
        f"{path.relative_to(root)}:{number}: {line.strip()}"
        for path in _text_files(root)
        for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1)
        if MACHINE_PATH.search(line)
    ]
    assert found == []


@pytest.mark.parametrize(
    "script", [".ci/run", "scripts/lock.sh", "scripts/setup.sh", "scripts/test_other.sh"]
)
def test_script_can_be_executed(script, root):
    assert (root / script).stat().st_mode & 0o111


THINGS = """
frame pair point place loop pose image position view inlier feature warning session drive scene
segment byte row face triangle voxel tile gap coefficient
"""


def test_numbers_of_things_are_written_by_one_function(root):
    """So that none reads "1 frames"; constants, which are in capitals, are more than one."""
    plural = re.compile(
        rf"(\{{[^{{}}:]*[a-z][^{{}}:]*\}}+|%d) ({'|'.join(THINGS.split())})s\b(?! the)"
    )
    files = [*(root / "recon").rglob("*.py"), *(root / "recon").rglob("*.j2")]
    assert [
        (path.name, one[0]) for path in files for one in plural.finditer(path.read_text())
    ] == []


def test_the_page_of_the_architecture_names_what_is_there_in_the_order_that_is_enforced(
    root, pyproject
):
    page = (root / "docs" / "architecture.md").read_text()
    named = re.findall(r"`(recon/[\w/]+(?:\.py|/))`", page)
    assert len(named) > 20
    assert [path for path in named if not (root / path).exists()] == []
    section = page.partition("## Rooms")[2].partition("\n## ")[0]
    rooms = re.findall(r"^\| `(\w+)/` \|", section, re.MULTILINE)
    contracts = pyproject["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    assert ["__main__", *rooms] == layers


def test_every_file_that_a_room_names_is_in_it(root):
    """The docstring of a room leads a reader to the files to begin with."""
    files = list((root / "recon").glob("*/**/__init__.py"))
    named = {f.parent: re.findall(r"`([\w/]+(?:\.py|/))`", f.read_text()) for f in files}
    beside = {room.name for room in named}
    missing = [
        f"{room.name}: {name}"
        for room, names in named.items()
        for name in names
        if not any((folder / name).exists() for folder in (room, room.parent))
        and name.strip("/") not in beside
    ]
    assert missing == []
    assert sum(map(len, named.values())) > 150


def test_the_story_of_a_command_fits_on_a_screen_or_two(trees, root):
    lengths = {
        node.name: (node.end_lineno or 0) - node.lineno
        for path in (root / "recon" / "commands").glob("*.py")
        for node in trees[path].body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("run_")
    }
    assert len(lengths) > 20
    assert {name: lines for name, lines in lengths.items() if lines > 100} == {}


def test_benchmarks_import_what_is_there(trees, root):
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


def test_a_benchmark_measures_the_checkout_that_it_stands_in(root, tmp_path):
    """Also in what it starts; Python looks first at the place of the benchmark, then at others."""
    other = tmp_path / "other" / "recon"
    other.mkdir(parents=True)
    (other / "__init__.py").write_text("raise SystemExit('another recon was imported')")
    starts_another = (
        "import checkout, subprocess, sys; "
        "sys.exit(subprocess.call([sys.executable, '-c', 'import recon; print(recon.__file__)']))"
    )
    env = {"PYTHONPATH": os.pathsep.join(map(str, [root / "benchmarks", other.parent]))}
    words = [sys.executable, "-c", starts_another]
    done = subprocess.run(
        words, env=os.environ | env, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert str(root / "recon" / "__init__.py") in done.stdout


def test_every_benchmark_says_first_what_is_measured(root):
    """What stands before the first import from the library decides from where that comes."""
    late = []
    for path in (root / "benchmarks").glob("*.py"):
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
    names = [n for n in ast.walk(tree) if isinstance(n, ast.Name)]
    stored = {n.id for n in names if isinstance(n.ctx, ast.Store)}
    made = {n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)}
    imports = (n for n in tree.body if isinstance(n, ast.ImportFrom | ast.Import))
    return stored | made | {a.asname or a.name for node in imports for a in node.names}


def test_no_files_import_each_other_in_a_circle():
    """But those of the command line: a batch checks its jobs as command lines of the program."""
    graph = grimp.build_graph("recon", exclude_type_checking_imports=True)
    names = sorted(graph.modules)
    edges = [
        (row, names.index(imported))
        for row, name in enumerate(names)
        for imported in graph.find_modules_directly_imported_by(name)
    ]
    ends = coo_matrix((np.ones(len(edges)), np.array(edges).T), shape=(len(names),) * 2)
    _, circle = connected_components(ends, connection="strong")
    met = [name for name, one in zip(names, circle, strict=True) if (circle == one).sum() > 1]
    assert len(edges) > 1000
    assert [name for name in met if not name.startswith("recon.cli")] == []


def test_no_contract_has_an_exemption(pyproject):
    contracts = pyproject["tool"]["importlinter"]["contracts"]
    assert [one["name"] for one in contracts if "ignore_imports" in one] == []


COMMANDS = ("ruff check --output-format concise", "ruff format --check", "mypy", "lint-imports")


@pytest.mark.parametrize("command", COMMANDS)
def test_static_check_passes(command, root):
    program, *arguments = command.split()
    words = [str(Path(sys.executable).with_name(program)), *arguments]
    done = subprocess.run(words, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
