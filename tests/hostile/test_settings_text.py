"""Hostile texts in ``--set``, ``--config`` and other options."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pytest

from recon.commands.config import load_config
from tests.hostile.calibrations import CONTENT, NUMBERS, deep, expanding
from tests.hostile.refusals import assert_refused, refusal, run

# The first match may have to compile.


def refused(path: Path | None, overrides: list[str], *words: str) -> None:
    line = refusal(lambda: load_config(path, overrides))
    assert line is not None
    for word in words:
        assert word in line


@pytest.mark.parametrize("number", sorted(set(NUMBERS) - {"minus 1e300", "null"}))
@pytest.mark.parametrize("setting", ["matching.sad.window_px", "source.tolerance_s", "matching"])
def test_a_hostile_value_of_a_setting_is_refused(setting: str, number: str) -> None:
    refused(None, [f"{setting}={NUMBERS[number]}"])


@pytest.mark.parametrize("nesting", deep(1))
def test_a_deeply_nested_value_is_refused(nesting: str) -> None:
    refused(None, [f"matching={deep(20_000)[nesting]}"])


@pytest.mark.parametrize("nesting", deep(1))
def test_a_deeply_nested_configuration_is_refused(nesting: str, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(deep(20_000)[nesting])
    refused(tmp_path / "c.yaml", [], "c.yaml")


@pytest.mark.parametrize(
    "key",
    ["", ".", "..", "a" * 5000, ".".join("a" * 5000), "\0", "matching.", ".matching", "é.²", "[1]"],
    ids=["empty", "dot", "dots", "long", "deep", "NUL", "dot last", "dot first", "letters", "list"],
)
def test_a_hostile_name_of_a_setting_is_refused(key: str) -> None:
    refused(None, [f"{key}=1"])


@pytest.mark.parametrize("change", CONTENT)
def test_a_spoiled_configuration_is_refused_or_harmless(change: str, tmp_path: Path) -> None:
    content = b"matching:\n  sad: {window_px: 9, ndisp: 50}\nmesh: {max_depth: 8}\n"
    (tmp_path / "c.yaml").write_bytes(CONTENT[change](content))
    line = refusal(lambda: load_config(tmp_path / "c.yaml"))
    assert line is None or "c.yaml" in line


def test_aliases_that_expand_without_bound_are_refused(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("\n".join(expanding()))
    refused(tmp_path / "c.yaml", [], "c.yaml")


VALUES: Final = dict(
    zip(
        ["date", "tag", "digits", "nested", "alias", "surrogate", "unknown"],
        ["2020-13-45", "!!int abc", "1" * 5000, "[" * 20_000, "&a [*a]", "\udc80", "*b"],
        strict=True,
    )
)


@pytest.mark.parametrize("name", VALUES)
def test_the_option_is_named(name: str, pair: tuple[Path, Path]) -> None:
    ended = run("disparity", *pair, "--set", f"matching.sad.window_px={VALUES[name]}")
    assert_refused(ended, "window_px")


@pytest.mark.parametrize(
    "command", ["pair", "map", "audit", "rectify", "paper", "demo", "calibrate", "mesh"]
)
def test_every_command_names_the_option(command: str, pair: tuple[Path, Path]) -> None:
    inputs = {
        "pair": (*pair, "--calib", "rig.yaml"),
        "map": (".",),
        "mesh": ("cloud.ply",),
        "audit": (".",),
        "rectify": pair,
        "calibrate": (*pair, "--board", "9x6:25mm"),
    }
    ended = run(command, *inputs.get(command, ()), "--set", "matching.sad.window_px=!!int abc")
    assert_refused(ended, "matching.sad.window_px")
    assert sorted(path.name for path in Path().iterdir()) == ["left.png", "right.png"]


@pytest.mark.parametrize("threads", ["1000000", "99999999999999999999"])
def test_more_threads_than_cores_are_harmless(threads: str, pair: tuple[Path, Path]) -> None:
    ended = run("disparity", *pair, "--threads", threads, "--quiet", "--out", "out")
    assert ended.code in {0, 1}
    assert len(ended.lines) <= 1


@pytest.mark.parametrize("limit", ["1e3", "-1G", "²G", "1" * 5000, "0.0", "G", "nan", "inf"])
def test_a_hostile_memory_limit_is_refused(limit: str, here: Path) -> None:
    ended = run("map", here, "--memory-limit", limit)
    assert ended.code in {1, 2}
    assert len(ended.lines[-1]) < 6000
    assert list(here.iterdir()) == []


NUMBERS_OF_OPTIONS: Final = {
    "a whole number": ("pair", "left.png", "right.png", "--threads"),
    "a number": ("pair", "left.png", "right.png", "--focal"),
    "a number of a group": ("map", "drive", "--focal"),
    "a number of a part": ("evaluate", "disparity", "a.pfm", "b.pfm", "--scale"),
    "an argument": ("piece", "plan"),
}


@pytest.mark.parametrize("option", NUMBERS_OF_OPTIONS)
@pytest.mark.parametrize("number", ["1_0", "\u0661\u0662"])
def test_an_option_takes_decimals_alone_for_numbers(option: str, number: str, here: Path) -> None:
    """Wrong usage, as is any other text that is no number."""
    ended = run(*NUMBERS_OF_OPTIONS[option], number)
    assert ended.code == 2
    assert "Invalid value for" in ended.err
    assert not list(here.iterdir())


def test_a_file_may_be_named_as_a_number_is_not(here: Path) -> None:
    assert_refused(run("map", "1_0"), "1_0", "exist")
