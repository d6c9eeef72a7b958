"""The public Python interface is what `recon.__all__` lists, and each name explains itself."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

import recon

EXPORTED = sorted(getattr(recon, "__all__", []))


def test_public_names_are_exactly_the_documented_ones(root: Path) -> None:
    text = (root / "docs" / "api.md").read_text()
    documented = {
        line.split("`")[1].split("(")[0] for line in text.splitlines() if line.startswith("- `")
    }

    assert set(EXPORTED) == documented


@pytest.mark.parametrize("name", EXPORTED)
def test_public_name_explains_itself(name: str) -> None:
    value = getattr(recon, name)

    if inspect.isfunction(value) or inspect.isclass(value):
        assert inspect.getdoc(value)
