"""Odd names of files and folders are read, or refused in one line."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

from recon.sources.image_names import natural_key
from recon.sources.registry import open_source
from recon.sources.times import stamp_of_name
from tests.hostile.refusals import assert_refused, refusal, run

# The first match may have to compile.
NAMES = {
    "Latin-1": os.fsdecode(b"caf\xe9"),
    "no UTF-8 at all": os.fsdecode(b"\xff\xfe\x80"),
    "a newline": "two\nlines",
    "an escape sequence": "\x1b[31mred",
    "markup": "[red]<b>&amp;",
    "quotes": 'it\'s "it"',
    "spaces": "  a  b ",
    "a dash": "-rf",
    "superscript digits": "frame²",
    "Arabic digits": "frame٣",
    "240 letters": "x" * 240,
    "braces": "{0}%s$HOME",
}


@pytest.mark.parametrize("name", NAMES)
def test_a_pair_in_a_folder_of_that_name_is_matched(name: str, pair: tuple[Path, Path]) -> None:
    folder = Path("in") / NAMES[name]
    folder.mkdir(parents=True)
    images = [shutil.move(path, folder / path.name) for path in pair]
    ended = run("disparity", *images, "--json", "--quiet", "--out", Path("out") / NAMES[name])
    assert ended.code == 0, ended.err
    assert json.loads(ended.out)["out"]
    assert ended.lines == []


@pytest.mark.parametrize("name", NAMES)
def test_what_is_missing_or_broken_is_named_in_one_line(name: str, pair: tuple[Path, Path]) -> None:
    assert_refused(run("disparity", f"./{NAMES[name]}.png", pair[1], "--out", "out"), ".png")
    broken = Path(f"{NAMES[name]}.png")
    broken.write_bytes(b"no image")
    assert_refused(run("disparity", f"./{broken}", pair[1], "--out", "out"), ".png")


@pytest.mark.parametrize("name", NAMES)
def test_a_drive_of_that_name_is_read(name: str, good_drive: Path, here: Path) -> None:
    folder = Path(shutil.copytree(good_drive, here / NAMES[name]))
    source = open_source(folder)
    assert len(list(source)) == 3
    assert NAMES[name] in source.name


@pytest.mark.parametrize("digits", ["²", "٣", "①", "५", "1²", "٣.png", "1" * 200])
def test_digits_of_any_script_are_sorted(digits: str) -> None:
    assert natural_key(digits)
    assert stamp_of_name("²" * 10) is None
    assert stamp_of_name("٣" * 19) is None


@pytest.mark.parametrize("digits", ["²", "٣", "①", "५"])
def test_images_with_digits_of_any_script_are_paired(digits: str, drive: Path) -> None:
    for number, path in enumerate(sorted(drive.glob("image_*/*.png"))):
        path.rename(path.with_name(f"{digits * (number % 3 + 1)}.png"))
    line = refusal(lambda: list(open_source(drive)))
    assert line is None or "drive" in line


STAMPS = {
    "400 digits": "1" * 400,
    "5000 digits": "1" * 5000,
    "nan": "nan",
    "inf": "inf",
    "negative": "-5",
    "a word": "now",
    "Arabic": "١٤٠٣",
    "superscript": "²",
    "1e19": "1e19",
    "a hole": "",
    "NUL": "\0",
}


@pytest.mark.parametrize("stamp", STAMPS)
@pytest.mark.parametrize("layout", ["euroc", "tum", "kitti", "kitti-raw", "folders"])
def test_a_hostile_time_stamp_is_read_or_refused(layout: str, stamp: str, drive: Path) -> None:
    text = STAMPS[stamp]
    left, right = (sorted((drive / f"image_{n}").iterdir()) for n in (0, 1))
    if layout == "kitti":
        (drive / "times.txt").write_text(f"0\n{text}\n2\n")
    elif layout == "folders":
        for side, paths in (("left", left), ("right", right)):
            (drive / side).mkdir()
            for path in paths:
                path.rename(drive / side / f"{text[:200].strip(chr(0))}{path.name}")
    elif layout == "tum":
        for side, paths in (("left", left), ("right", right)):
            lines = [f"{k} {p.relative_to(drive)}" for k, p in enumerate(paths)]
            lines[1] = f"{text} {paths[1].relative_to(drive)}"
            (drive / f"{side}.txt").write_text("\n".join(lines))
    else:
        for camera, paths in enumerate((left, right)):
            raw = layout == "kitti-raw"
            view = drive / (f"image_{camera:02d}" if raw else f"cam{camera}")
            (view / "data").mkdir(parents=True)
            for path in paths:
                shutil.copy(path, view / "data" / path.name)
            dates = ["2011-09-26 13:02:25.9", text, "2011-09-26 13:02:26.9"]
            rows = [f"{k * 10**8},{path.name}" for k, path in enumerate(paths)]
            rows[1] = f"{text},{paths[1].name}"
            name = "timestamps.txt" if raw else "data.csv"
            (view / name).write_text("\n".join(dates if raw else rows))
    line = refusal(lambda: list(open_source(drive, layout)))
    assert line is None or "drive" in line
