"""Damaged files of every kind are read, or refused by an error of ours that names them."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Final

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.hostile.fuzz import KINDS, TOKENS, Kind, damage
from tests.hostile.refusals import refusal

# Few where the examples are always the same; `make fuzz` searches long.
EXAMPLES: Final = 25 if settings.default.derandomize else 300


def valid(kind: Kind, folder: Path) -> bytes:
    """Write a valid file of a kind; its content."""
    kind.write(folder / kind.name)
    kind.read(folder / kind.name)
    return (folder / kind.name).read_bytes()


def check(kind: Kind, path: Path, content: bytes) -> bool:
    """Read a damaged file; whether it was refused, which must be by its name."""
    path.write_bytes(content)
    line = refusal(lambda: kind.read(path))
    assert line is None or path.stem in line, line
    return line is not None


@pytest.mark.parametrize("name", KINDS)
def test_a_file_cut_anywhere_is_read_or_refused(name: str, tmp_path: Path) -> None:
    kind = KINDS[name]
    content = valid(kind, tmp_path)
    for length in range(0, len(content), max(1, kind.every * len(content) // 40)):
        check(kind, tmp_path / kind.name, content[:length])


@pytest.mark.parametrize("name", KINDS)
def test_a_file_with_a_token_in_it_is_read_or_refused(name: str, tmp_path: Path) -> None:
    kind = KINDS[name]
    content = valid(kind, tmp_path)
    step = max(1, len(content) // 3)
    for at in range(0, len(content), step):
        for token in TOKENS[:: kind.every]:
            check(kind, tmp_path / kind.name, content[:at] + token + content[at + len(token) :])


@pytest.mark.parametrize(
    "name", [name for name in KINDS if KINDS[name].every == 1 or not settings.default.derandomize]
)
@given(data=st.data())
@settings(
    max_examples=EXAMPLES, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)
def test_a_damaged_file_is_read_or_refused(name: str, data: st.DataObject) -> None:
    kind = KINDS[name]
    with tempfile.TemporaryDirectory() as folder:
        kind.write(Path(folder) / kind.name)
        content = (Path(folder) / kind.name).read_bytes()
        damaged = data.draw(st.composite(lambda draw: damage(draw, content))())
        check(kind, Path(folder) / kind.name, damaged)
