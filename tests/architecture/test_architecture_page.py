"""The page that leads through the code names what is there, in the order that is enforced."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture(scope="module")
def page(root: Path) -> str:
    return (root / "docs" / "architecture.md").read_text()


def section(page: str, title: str) -> str:
    """What stands below a heading, up to the next."""
    _, _, rest = page.partition(f"## {title}")
    return rest.partition("\n## ")[0]


def test_every_file_of_the_page_exists(page: str, root: Path) -> None:
    named = re.findall(r"`(recon/[\w/]+(?:\.py|/))`", page)

    assert len(named) > 20
    assert [path for path in named if not (root / path).exists()] == []


def test_the_rooms_are_those_whose_order_is_enforced(page: str, pyproject: dict[str, Any]) -> None:
    rooms = re.findall(r"^\| `(\w+)/` \|", section(page, "Rooms"), re.MULTILINE)
    contracts = pyproject["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")

    assert ["__main__", *rooms] == layers


def test_every_file_that_a_room_names_is_in_it(root: Path) -> None:
    """The docstring of a room leads a reader to the files to begin with."""
    rooms = [path.parent for path in (root / "recon").glob("*/**/__init__.py")]
    named = {
        room: re.findall(r"`([\w/]+(?:\.py|/))`", (room / "__init__.py").read_text())
        for room in rooms
    }

    beside = {room.name for room in rooms}
    missing = [
        f"{room.name}: {name}"
        for room, names in named.items()
        for name in names
        if not any((folder / name).exists() for folder in (room, room.parent))
        and name.strip("/") not in beside
    ]
    assert missing == []
    assert sum(map(len, named.values())) > 150


def test_a_story_fits_on_a_screen_or_two(root: Path) -> None:
    """The stories of the commands, with their docstrings."""
    lengths = {
        node.name: (node.end_lineno or 0) - node.lineno
        for path in (root / "recon" / "commands").glob("*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("run_")
    }
    assert len(lengths) > 20
    assert {name: lines for name, lines in lengths.items() if lines > 100} == {}
