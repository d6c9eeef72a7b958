"""Small documents from elsewhere, whatever is in them: refused in one line that names the file."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pytest

from tests.hostile.refusals import assert_refused, run

pytestmark = pytest.mark.usefixtures("blank_figures")

TEXTS: Final = {
    "nothing": b"",
    "a word": b"word",
    "a list": b"[1]",
    "null": b"null",
    "a list of null": b"[null]",
    "a number": b"5",
    "5000 digits": b"9" * 5000,
    "too large a number": b'{"a": 1e999}',
    "a NUL": b'{"a": "\\u0000"}\x00',
    "a surrogate": b'{"\\ud800": ["\\udfff"]}',
    "nested": b"[" * 100_000,
    "nested mappings": b'{"a":' * 100_000,
    "not UTF-8": b"\xff\xfe{}",
}
READERS: Final[dict[str, tuple[str, tuple[str, ...]]]] = {
    "settings": ("c.yaml", ("disparity", "left.png", "right.png", "--config", "c.yaml")),
    "jobs in YAML": ("jobs.yaml", ("batch", "jobs.yaml")),
    "jobs in TOML": ("jobs.toml", ("batch", "jobs.toml")),
    "calibration": ("calib.yaml", ("pair", "left.png", "right.png", "--calib", "calib.yaml")),
    "poses": ("poses.txt", ("map", "drive", "--poses", "poses.txt")),
    "prior": ("prior.txt", ("map", "drive", "--prior", "prior.txt")),
}


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("reader", READERS)
def test_a_document_that_is_none_is_refused(
    reader: str, text: str, drive: Path, pair: tuple[Path, Path]
) -> None:
    name, command = READERS[reader]
    Path(name).write_bytes(TEXTS[text])
    if reader == "settings" and text in ("nothing", "null"):
        pytest.skip("settings that are left out are the defaults")
    assert_refused(run(*command, "--out", "out"), name)
    assert not Path("out").exists()


@pytest.mark.parametrize("text", TEXTS)
def test_measured_positions_that_are_none_are_refused(text: str, finished: Path) -> None:
    pytest.importorskip("laspy")
    Path("gnss.txt").write_bytes(TEXTS[text])
    words = ("export", "run", "--to", "las", "--georeference", "gnss.txt", "--antenna=0,0,0")
    assert_refused(run(*words, "--out", "out"), "gnss.txt")
    assert not Path("out").exists()


@pytest.mark.parametrize("text", TEXTS)
def test_a_summary_of_a_pair_that_is_none_is_refused(text: str, here: Path) -> None:
    (here / "run").mkdir()
    (here / "run/run.json").write_text('{"command": "pair"}')
    (here / "run/summary.json").write_bytes(TEXTS[text])
    assert_refused(run("mesh", "run", "--out", "out"), "summary.json")
    assert not Path("out").exists()
