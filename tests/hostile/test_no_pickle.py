"""Nothing that is read can run code or name classes."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

import recon

_FORBIDDEN: Final = frozenset(
    {"pickle", "cPickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}
)
_UNSAFE_YAML: Final = frozenset(
    {"load", "load_all", "full_load", "unsafe_load", "full_load_all", "unsafe_load_all"}
)
_RUNS_TEXT: Final = frozenset({"eval", "exec", "compile", "__import__"})
_ROOT: Final = Path(recon.__file__).parent
_MODULES: Final = sorted(_ROOT.rglob("*.py"))


def dangers(tree: ast.AST) -> Iterator[str]:
    """What could run code that a file contains."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                yield from (n.name for n in names if n.name.partition(".")[0] in _FORBIDDEN)
            case ast.ImportFrom(module=str(module)) if module.partition(".")[0] in _FORBIDDEN:
                yield module
            case ast.keyword(arg="allow_pickle", value=value):
                if not (isinstance(value, ast.Constant) and value.value is False):
                    yield "allow_pickle"
            case ast.Attribute(value=ast.Name(id="yaml"), attr=attr) if attr in _UNSAFE_YAML:
                yield f"yaml.{attr}"
            case ast.Attribute(value=ast.Name(id="torch"), attr="load"):
                yield "torch.load"
            case ast.Call(func=ast.Name(id=name)) if name in _RUNS_TEXT:
                yield name


@pytest.mark.parametrize("path", _MODULES, ids=lambda path: path.relative_to(_ROOT).as_posix())
def test_no_module_can_run_what_it_reads(path: Path) -> None:
    assert list(dangers(ast.parse(path.read_text(encoding="utf-8")))) == []


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "from pickle import loads",
        "import os, marshal as m",
        "np.load(f, allow_pickle=True)",
        "np.load(f, allow_pickle=allowed)",
        "yaml.load(text)",
        "yaml.unsafe_load(text)",
        "eval(text)",
    ],
)
def test_the_search_finds_what_it_looks_for(code: str) -> None:
    assert list(dangers(ast.parse(code)))
