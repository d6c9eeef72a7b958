"""Hostile calibration files, given to commands that read one."""

from __future__ import annotations

from pathlib import Path

import pytest

from recon.io.cameras.calibration import read_calibration
from recon.io.files import SMALL_FILE_BYTES
from tests.hostile.calibrations import (
    CONTENT,
    KALIBR,
    NUMBERS,
    OPENCV,
    OURS,
    VALID,
    deep,
    expanding,
    replace_one,
    write_valid,
)
from tests.hostile.refusals import assert_refused, refusal, run, run_apart

# The first match may have to compile.
LEVELS = 20_000


def refused(path: Path, *words: str) -> None:
    """Assert that a file is refused by name, whatever it is."""
    line = refusal(lambda: read_calibration(path, 48, 32))
    assert line is not None
    assert path.stem.split("_")[0] in line
    for word in words:
        assert word in line


@pytest.mark.parametrize("kind", VALID)
def test_the_valid_files_are_valid(kind: str, tmp_path: Path) -> None:
    assert read_calibration(write_valid(tmp_path, kind), 48, 32) is not None


@pytest.mark.parametrize("change", CONTENT)
@pytest.mark.parametrize("kind", VALID)
def test_spoiled_content_is_refused_or_harmless(kind: str, change: str, tmp_path: Path) -> None:
    path = write_valid(tmp_path, kind)
    path.write_bytes(CONTENT[change](path.read_bytes()))
    line = refusal(lambda: read_calibration(path, 48, 32))
    assert line is None or path.stem.split("_")[0] in line


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize(
    ("name", "text", "old"),
    [
        ("rig.yaml", OURS, "48"),
        ("rig.yaml", OURS, "50.0"),
        ("rig.yaml", OURS, "0.1"),
        ("rig.yaml", OURS, "1\n"),
        ("chain.yaml", KALIBR, "50.0"),
        ("chain.yaml", KALIBR, "48"),
        ("chain.yaml", KALIBR, "-0.1"),
        ("chain.yaml", KALIBR, "[48, 32]"),
        ("chain.yaml", KALIBR, "radtan"),
        ("stereo.yml", OPENCV, "48"),
        ("stereo.yml", OPENCV, "50."),
        ("stereo.yml", OPENCV, "-0.1"),
        ("stereo.yml", OPENCV, "rows: 3"),
    ],
    ids=lambda value: value if len(value) < 10 else "",
)
def test_a_hostile_number_raises_nothing_but_our_errors(
    name: str, text: str, old: str, number: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(replace_one(text, old, NUMBERS[number] + "\n" * old.endswith("\n")))
    line = refusal(lambda: read_calibration(path, 48, 32))
    assert line is None or name in line


@pytest.mark.parametrize("number", ["5000 digits", "date", "tag int abc", "list", "nan", "zero"])
@pytest.mark.parametrize("field", ["width_px", "focal_px", "baseline_m"])
def test_a_hostile_field_of_our_file_is_refused(field: str, number: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    text = OURS.replace("\n  ", " ")
    begin = text.index(f"{field}: ") + len(field) + 2
    end = min(at for at in (text.find(",", begin), text.find("}", begin)) if at > 0)
    path.write_text(text[:begin] + NUMBERS[number] + text[end:])
    refused(path)


@pytest.mark.parametrize("nesting", deep(1))
def test_deep_nesting_is_refused(nesting: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(deep(LEVELS)[nesting])
    refused(path)


@pytest.mark.slow
@pytest.mark.parametrize("nesting", ["opencv yaml lists", "opencv xml", "opencv json"])
def test_very_deep_nesting_does_not_end_the_process(nesting: str, pair: tuple[Path, Path]) -> None:
    Path("rig.yml").write_text(deep(200_000)[nesting])
    assert_refused(run_apart("pair", *pair, "--calib", "rig.yml", "--out", "out"), "rig.yml")
    assert not Path("out").exists()


def test_aliases_that_expand_without_bound_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "chain.yaml"
    chain = replace_one(KALIBR, "[50.0, 50.0, 24.0, 16.0]", "*l9")
    path.write_text("\n".join([*expanding(), chain]))
    refused(path, "aliases")


def test_matrices_larger_than_their_data_are_not_allocated(tmp_path: Path) -> None:
    path = tmp_path / "stereo.yml"
    path.write_text(OPENCV.replace("rows: 3", "rows: 300000").replace("cols: 3", "cols: 300000"))
    read_calibration(path, 48, 32)


def test_a_file_larger_than_any_calibration_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    with path.open("wb") as file:
        file.truncate(50 * SMALL_FILE_BYTES)
    refused(path, "too large")


@pytest.mark.parametrize("command", ["pair", "disparity", "rectify", "map", "audit"])
def test_every_command_names_the_file(command: str, pair: tuple[Path, Path], drive: Path) -> None:
    Path("rig.yaml").write_text(OURS.replace("48", "!!int abc"))
    inputs = pair if command in {"pair", "disparity", "rectify"} else (drive,)
    out = () if command == "audit" else ("--out", "out")
    assert_refused(run(command, *inputs, "--calib", "rig.yaml", *out), "rig.yaml")
    assert not Path("out").exists()
