"""The package declares, installs, loads and exports exactly what it should."""

import ast
import importlib.util
import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import packages_distributions

import pytest
import yaml

import recon
from recon.commands.doctor import PACKAGES, SYSTEM_LIBRARIES
from recon.core.errors import DISTRIBUTION

# What numba takes from scipy: it is compiled without, and fails when it is called.
FROM_SCIPY = {"linalg", "dot", "vdot", "matmul", "tensordot", "roots", "cov", "corrcoef"}


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", re.split(r"[\[<>=!~; ]", name)[0]).lower()


@pytest.fixture(scope="module")
def imported(trees):
    """Names of the libraries that are imported, with the names that they could be declared by."""
    names = set()
    for tree in trees.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.add(node.module.split(".")[0])
            elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Lazy":
                names.add(ast.literal_eval(node.args[0]))
    providers = packages_distributions()
    return {
        name: {_normal(provider) for provider in providers.get(name, [name])}
        for name in names - set(sys.stdlib_module_names) - {"recon"}
    }


def test_what_is_imported_is_declared_and_pinned_and_nothing_else(imported, pyproject, root):
    declared = {_normal(entry) for entry in pyproject["project"]["dependencies"]}
    assert {name for name, providers in imported.items() if not declared & providers} == set()
    assert declared - set().union(*imported.values()) == set()
    lines = (root / "constraints.txt").read_text().splitlines()
    pinned = {_normal(line) for line in lines if "==" in line and not line.startswith("#")}
    assert (
        declared | set(map(_normal, pyproject["project"]["optional-dependencies"]["dev"])) <= pinned
    )


def test_the_lock_has_the_versions_of_the_constraints_with_hashes_and_names_no_place(root):
    lock = (root / "constraints.lock").read_text()
    locked = {
        (_normal(name), version): entry.count("--hash=sha256:")
        for entry in re.split(r"^(?=\S)", lock, flags=re.MULTILINE)
        for name, version in re.findall(r"^([\w.-]+)==(\S+)", entry)
    }
    assert min(locked.values()) >= 1
    lines = (root / "constraints.txt").read_text().splitlines()
    pinned = {(_normal(line), line.split("==")[1].split()[0]) for line in lines if "==" in line}
    assert pinned <= set(locked)
    other = {"appnope", "cffi", "pycparser", "pyreadline3"}  # of other systems, and of PyPy
    assert {name for name, _ in set(locked) - pinned} == other
    assert not re.search(r"://|index-url|find-links", lock)


def test_every_optional_library_is_declared_by_the_extra_that_its_error_names(trees, pyproject):
    extras = pyproject["project"]["optional-dependencies"]
    asked = {pair for tree in trees.values() for pair in _required(tree)}
    providers = packages_distributions()
    assert {extra for _, extra in asked} == set(extras) - {"dev", "docs"}
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


def test_kernels_need_no_linear_algebra_of_scipy(trees):
    """What numba compiles is decorated with `kernel`, with options or without."""
    found = [
        f"{path.name}:{node.lineno}"
        for path, tree in trees.items()
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef)
        for mark in function.decorator_list
        if ast.unparse(getattr(mark, "func", mark)) == "kernel"
        for node in ast.walk(function)
        if (isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult))
        or (isinstance(node, ast.Attribute) and node.attr in FROM_SCIPY)
    ]
    assert found == []


def test_version_is_the_same_everywhere(root, pyproject):
    version = pyproject["project"]["version"]
    assert recon.__version__ == version
    cited = yaml.safe_load((root / "CITATION.cff").read_text())
    heading = f"## [{version}] - {cited['date-released']}"
    assert str(cited["version"]) == version
    assert heading in (root / "CHANGELOG.md").read_text().splitlines()


def test_what_messages_and_pages_tell_to_install_is_this_package(root, pyproject):
    """And not the project of biology that is called as what is imported."""
    assert pyproject["project"]["name"] == DISTRIBUTION != "recon"
    pages = [root / "README.md", *(root / "docs").glob("*.md"), *(root / "scripts").glob("*.*")]
    files = [*pages, *(root / "recon").rglob("*.py")]
    wrong = re.compile(r"(?<![\w-])recon\\?\[(?:cluster|onnx|ros|sfm|survey|view|dev|NAME)\\?\]")
    assert [path.name for path in files if wrong.search(path.read_text())] == []


def test_doctor_looks_for_what_is_installed(root, pyproject):
    entry = re.compile(r"^ +(lib\S+\.so\S*?):(\S+)", re.MULTILINE)
    installed = dict(entry.findall((root / "scripts" / "setup.sh").read_text()))
    assert dict(SYSTEM_LIBRARIES) == installed
    declared = {re.split("[>= ]", entry)[0] for entry in pyproject["project"]["dependencies"]}
    unneeded = {"tomli"} if sys.version_info >= (3, 11) else set()
    assert set(PACKAGES) == declared - unneeded


def test_public_names_are_exactly_the_documented_ones_and_explain_themselves(root):
    """The page has `::: recon.NAME`, from which the site shows signature and docstring."""
    page = (root / "docs" / "api.md").read_text()
    documented = re.findall(r"^::: recon\.(\w+)$", page, re.MULTILINE)
    assert sorted(documented) == sorted(recon.__all__)
    values = [getattr(recon, name) for name in documented]
    named = [each for each in values if inspect.isfunction(each) or inspect.isclass(each)]
    assert [each for each in named if not inspect.getdoc(each)] == []


@pytest.fixture(scope="module")
def interface(root):
    """`scripts/record_interface.py`, which writes the files that are compared here."""
    path = root / "scripts" / "record_interface.py"
    spec = importlib.util.spec_from_file_location("record_interface", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_public_names_parameters_and_defaults_are_the_recorded_ones(interface):
    """What is gone or changed breaks programs of users: deprecate it, or say so in CHANGELOG.md."""
    recorded, found = interface.NAMES.read_text().splitlines(), interface.public_names()
    gone, new = set(recorded) - set(found), set(found) - set(recorded)
    assert (sorted(gone), sorted(new)) == ([], []), "run `make interface` once this is meant"


def test_the_page_of_commands_is_the_help_of_today(interface):
    page = interface.COMMANDS.read_text()
    assert page == interface.commands_page(), "run `make interface`"


HEAVY = {
    "cv2", "kiss_icp", "matplotlib", "numba", "open3d", "plotly", "pymeshlab", "pyoctomap",
}  # fmt: skip


def loaded(probe: str) -> set[str]:
    """The modules that a process has loaded at its end."""
    command = [sys.executable, "-c", f"{probe}\nimport sys; print('LOADED', *sys.modules)"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(done.stdout.rpartition("LOADED")[2].split())


def test_help_loads_the_shells_and_neither_libraries_nor_numbers_nor_settings():
    """What it takes is measured by `benchmarks/two_checkouts.py`; this is what makes it little."""
    found = loaded(
        "import contextlib, sys; sys.argv = ['recon', '--help']; from recon.cli import main\n"
        "with contextlib.suppress(SystemExit): main()"
    )
    assert found.isdisjoint(HEAVY | {"numpy", "pydantic", "scipy", "dask"})
    rooms = {name.split(".")[1] for name in found if name.startswith("recon.")}
    assert rooms == {"cli", "core"}


# The second meshes, in a process for each tile of a surface.
@pytest.mark.parametrize("module", ["recon", "recon.export.pymeshlab"])
def test_imports_load_no_heavy_library(module):
    assert loaded(f"import {module}").isdisjoint(HEAVY)


def test_doctor_loads_nothing_whose_lack_it_reports():
    shell = {"typer", "rich", "typing_extensions"}  # without these there is no command line
    found = loaded("import recon.cli.getting_started, recon.commands.doctor")
    assert found & set(PACKAGES.values()) <= shell
