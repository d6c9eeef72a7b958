"""Hostile images and clouds: too large, damaged, tiny, of no regular file, oddly named."""

import json
import os
import re
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import pytest

from recon.core.values import PointCloud, StereoPair
from recon.core.values.arrays import Float32
from recon.io.images.disparity import read_pfm
from recon.io.images.image import read_image, stated_size, write_image
from recon.io.models.ply import read_ply, write_ply
from recon.sources.registry import open_source
from tests.hostile.calibrations import OURS
from tests.hostile.refusals import assert_refused, refusal, run
from tests.sources import drives
from tests.sources.drives import Writer


def chunk(name: bytes, content: bytes) -> bytes:
    checksum = struct.pack(">I", zlib.crc32(name + content))
    return struct.pack(">I", len(content)) + name + content + checksum


def png(width: int, height: int, rows: int = 1) -> bytes:
    """A grey PNG that claims a size and holds some black rows."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    packed = zlib.compress(bytes(rows * (min(width, 1 << 20) + 1)))
    parts = chunk(b"IHDR", header), chunk(b"IDAT", packed), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def jpeg(width: int, height: int) -> bytes:
    content = bytearray(cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes())
    at = content.index(b"\xff\xc0")
    content[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(content)


def tiff(width: int, height: int, order: str = "<") -> bytes:
    start = b"II*\0" if order == "<" else b"MM\0*"
    entries = [(256, width), (257, height), (258, 8)]
    packed = b"".join(struct.pack(order + "HHII", tag, 4, 1, value) for tag, value in entries)
    return start + struct.pack(order + "IH", 8, len(entries)) + packed + bytes(4)


def bmp(width: int, height: int) -> bytes:
    return struct.pack(
        "<2sIHHIIiiHHIIIIII", b"BM", 54, 0, 0, 54, 40, width, height, 1, 24, *[0] * 6
    )


HUGE: Final[dict[str, bytes]] = {
    "png 20000x20000": png(20_000, 20_000),
    "png of the largest size": png(2**31 - 1, 2**31 - 1),
    "png one row too long": png(2**31 - 1, 1),
    "jpeg 65500x65500": jpeg(65_500, 65_500),
    "tiff little endian": tiff(10**6, 10**6),
    "tiff big endian": tiff(10**6, 10**6, ">"),
    "bmp": bmp(2**31 - 1, 2**31 - 1),
    "bmp upside down": bmp(30_000, -30_000),
    "pgm": b"P5 100000 100000 255\n" + bytes(100),
    "ppm": b"P6 999999999 999999999 65535\n" + bytes(100),
    "ascii pgm": b"P2 100000 100000 255\n0 0 0",
}


@pytest.mark.parametrize("kind", HUGE)
def test_an_image_of_too_many_pixels_is_not_decoded(kind, tmp_path):
    (tmp_path / "left.png").write_bytes(HUGE[kind])
    assert "too many pixels" in (refusal(lambda: read_image(tmp_path / "left.png")) or "")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp", ".pgm", ".ppm"])
def test_the_size_is_that_of_the_decoded_image(suffix):
    colour = (23, 31, 3) if suffix == ".ppm" else (23, 31)
    done, content = cv2.imencode(suffix, np.zeros(colour, np.uint8))
    assert done
    assert stated_size(content.tobytes()) == (31, 23)


def test_settings_and_the_memory_limit_bound_the_pixels(pair):
    few = ("--set", "source.max_megapixels=0.001")
    assert_refused(run("disparity", *pair, *few, "--out", "out"), "left.png", "max_megapixels")
    for path in pair:
        write_image(path, np.zeros((250, 250), np.uint8))
    small = ("--set", "memory.limit_mb=1")
    assert_refused(run("disparity", *pair, *small, "--out", "out"), "left.png", "pixels")
    assert not Path("out").exists()


SPECIAL: Final[dict[str, Callable[[Path], None]]] = {
    "a pipe": os.mkfifo,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a folder": Path.mkdir,
    "a link to itself": lambda path: path.symlink_to(path.name),
    "a link to nothing": lambda path: path.symlink_to("nothing"),
}
COMMANDS: Final = (
    "pair FILE right.png --calib rig.yaml",
    "pair left.png FILE --calib rig.yaml",
    "pair left.png right.png --calib FILE",
    "pair left.png right.png --calib rig.yaml --truth FILE",
    "disparity FILE right.png",
    "disparity left.png right.png --config FILE",
    "rectify FILE right.png",
    "map FILE",
    "audit FILE",
    "mesh FILE",
    "occupancy FILE",
    "capture FILE right.png --out out --frames 1",
    "calibrate FILE right.png --board chess:9x6:25mm --out c.yaml",
    "evaluate trajectory FILE FILE",
    "evaluate disparity FILE FILE",
    "evaluate map FILE FILE",
    "evaluate occupancy FILE",
    "evaluate middlebury FILE",
    "paper FILE",
)


@pytest.mark.parametrize("kind", SPECIAL)
@pytest.mark.parametrize("command", COMMANDS)
def test_an_irregular_file_is_refused(command, kind, pair):
    Path("rig.yaml").write_text(OURS)
    SPECIAL[kind](Path("odd.png"))
    before = sorted(path.name for path in Path().iterdir())
    assert_refused(run(*command.replace("FILE", "odd.png").split()), "odd.png")
    assert sorted(path.name for path in Path().iterdir()) == before


@pytest.mark.parametrize("content", [
    b"Pf " + b"9" * 5000 + b" 1 -1\n",
    b"Pf 1 " + b"9" * 5000 + b" -1\n",
    b"Pf 99999999 99999999 -1\n" + bytes(100),
    b"Pf 1 1 " + b"9" * 5000 + b"\n" + bytes(4),
    *(b"Pf 1 1 " + scale + b"\n" + bytes(4) for scale in (b"1e-999", b"nan", b"1e+e")),
    *(
        b"Pf " + size + b" -1\n" + bytes(4)
        for size in (b"0 5", b"-1 -1", "\u0661 \u0661".encode())
    ),
    *(b"Pf\n1 1\n-1.0\n" + bytes(3), b"PF 1 1 -1\n" + bytes(12), b"Pf", b"P"),
], ids=lambda content: content[:20].decode(errors="replace").strip()[:18])  # fmt: skip
def test_a_hostile_pfm_is_refused(content, tmp_path):
    (tmp_path / "d.pfm").write_bytes(content)
    assert "d.pfm" in (refusal(lambda: read_pfm(tmp_path / "d.pfm")) or "")


@pytest.mark.parametrize("content", [
    b"P5 " + b"9" * 5000 + b" 1 255\n",
    b"P5 1 " + b"9" * 5000 + b" 255\n",
    b"P5 1 1 " + b"9" * 5000 + b"\n0",
    *(b"P5 0 0 255\n", b"P5 -1 1 255\n0", b"P5 1 1 0\n0", b"P5 1 1 99999\n0", b"P5 1"),
    *(b"P2 2 2 255\nx y z w", b"P2 2 2 255\n1 2 3 99999999999999999999"),
    *(b"P4 8 8\n" + bytes(8), b"P7\nWIDTH 1\n", "P5 \u0661 \u0661 255\n0".encode()),
    *(b"BM", b"BM" + b"\xff" * 60, b"II*\0" + b"\xff" * 60, b"MM\0*"),
    *(b"\x89PNG\r\n\x1a\n", b"\x89PNG\r\n\x1a\n" + b"\xff" * 60),
    *(b"\xff\xd8\xff", b"\xff\xd8" + b"\xff" * 60, b"\xff\xd8\xff\xe0\xff\xff"),
    *(b"\0" * 1000, b"GIF89a" + bytes(20), b"%PDF-1.4"),
], ids=lambda content: repr(content[:12])[2:-1])  # fmt: skip
def test_a_hostile_header_of_an_image_is_refused(content, tmp_path):
    (tmp_path / "i.png").write_bytes(content)
    assert "i.png" in (refusal(lambda: read_image(tmp_path / "i.png")) or "i.png")


MATCHED: Final = [
    f"{command} --matcher {matcher}"
    for command in ("disparity", "pair")
    for matcher in ("sad", "sgm", "opencv-bm", "opencv-sgbm")
]


@pytest.mark.parametrize("size", [(1, 1), (1, 48), (48, 1), (2, 2), (3, 1000), (1000, 3)])
@pytest.mark.parametrize("command", ["rectify", *MATCHED])
def test_a_tiny_image_is_matched_or_refused(command, size, here):
    image = np.random.default_rng(1).integers(0, 255, size, np.uint8)
    for name in ("left.png", "right.png"):
        write_image(here / name, image)
    rig = OURS.replace("width_px: 48", f"width_px: {size[1]}")
    Path("rig.yaml").write_text(rig.replace("height_px: 32", f"height_px: {size[0]}"))
    calib = () if command.startswith("disparity") else ("--calib", "rig.yaml")
    ended = run(*command.split(), "left.png", "right.png", *calib, "--quiet", "--out", "out")
    if ended.code == 0:
        assert Path("out/run.json").is_file()
    else:
        assert_refused(ended)
        assert not Path("out").exists()


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
def test_a_pair_in_a_folder_of_that_name_is_matched(name, pair):
    folder = Path("in") / NAMES[name]
    folder.mkdir(parents=True)
    images = [shutil.move(path, folder / path.name) for path in pair]
    ended = run("disparity", *images, "--json", "--quiet", "--out", Path("out") / NAMES[name])
    assert ended.code == 0, ended.err
    assert json.loads(ended.out)["out"]
    assert ended.lines == []


@pytest.mark.parametrize("name", NAMES)
def test_what_is_missing_or_broken_is_named_in_one_line(name, pair):
    broken = Path(f"{NAMES[name]}.png")
    for _ in range(2):
        assert_refused(run("disparity", f"./{broken}", pair[1], "--out", "out"), ".png")
        broken.write_bytes(b"no image")


@pytest.mark.parametrize("name", NAMES)
def test_a_drive_of_that_name_is_read(name, good_drive, here):
    source = open_source(Path(shutil.copytree(good_drive, here / NAMES[name])))
    assert len(list(source)) == 3
    assert NAMES[name] in source.name


NOISE: Final = np.random.default_rng(3).integers(0, 255, (32, 64), np.uint8)
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


LISTS: Final[dict[str, tuple[Writer, str]]] = {
    "kitti": (drives.write_kitti, "times.txt"),
    "euroc": (drives.write_euroc, "data.csv"),
    "tum": (drives.write_tum, "*t.txt"),
    "kitti-raw": (drives.write_kitti_raw, "timestamps.txt"),
    "folders": (drives.write_folders, "*1.png"),
}


@pytest.mark.parametrize("stamp", STAMPS)
@pytest.mark.parametrize("layout", LISTS)
def test_a_hostile_time_stamp_is_read_or_refused(layout, stamp, here):
    (write, files), text = LISTS[layout], STAMPS[stamp]
    pairs = [StereoPair(NOISE, NOISE, 0.1 * index, index) for index in range(3)]
    drive = write(pairs, drives.CAMERA, here / "drive")
    for path in drive.rglob(files):
        if path.suffix == ".png":
            path.rename(path.with_name(f"{text[:200].strip(chr(0))}{path.name}"))
        else:
            lines = path.read_text().splitlines()
            lines[-2] = re.sub(r"^\d[-:.+ e\d]*\d", lambda _: text, lines[-2])
            path.write_text("\n".join(lines))
    line = refusal(lambda: list(open_source(drive, layout)))
    assert line is None or drive.name in line


def _ball(count: int = 300) -> Float32:
    return np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)


CLOUDS: Final[dict[str, Float32]] = {
    "few points": _ball(10),
    "one line": np.outer(np.arange(300), [1, 2, 3]).astype(np.float32),
    "one place": np.ones((300, 3), np.float32),
    "a far point": np.concatenate([np.full((1, 3), 1e30, np.float32), _ball()]),
    "all points far apart": _ball() * np.float32(1e20),
    "no point": _ball(0),
}
APART: Final = ("a far point", "all points far apart", "no point")


@pytest.mark.parametrize("spoiled", CLOUDS)
def test_a_cloud_without_a_surface_is_named(spoiled, here):
    write_ply("spoiled.ply", PointCloud(CLOUDS[spoiled]))
    assert_refused(run("mesh", "spoiled.ply", "--out", "out", "--quiet"), "spoiled.ply: ")
    assert not Path("out").exists()


@pytest.mark.parametrize("spoiled", APART)
@pytest.mark.parametrize("names", [("good.ply", "spoiled.ply"), ("spoiled.ply", "good.ply")])
def test_an_incomparable_cloud_is_named(spoiled, names, here):
    write_ply("spoiled.ply", PointCloud(CLOUDS[spoiled]))
    write_ply("good.ply", PointCloud(_ball()))
    assert_refused(run("evaluate", "map", *names), "spoiled.ply")


def test_rows_without_a_column_are_not_read_for_ever(here):
    element = "element nothing 1000000000000\n"
    Path("a.ply").write_text(
        f"ply\nformat ascii 1.0\n{element}element vertex 1\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    assert (refusal(lambda: read_ply("a.ply")) or "").startswith("a.ply: the file is truncated")
