"""Hostile images: too large, of no regular file, damaged, tiny, oddly named."""

from __future__ import annotations

import os
import struct
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import pytest

from recon.io.images.disparity import read_pfm, write_pfm
from recon.io.images.image import read_image, write_image
from recon.io.images.image_header import stated_size
from tests.hostile.calibrations import OURS
from tests.hostile.refusals import assert_refused, refusal, run

# The first match may have to compile.


def chunk(name: bytes, content: bytes) -> bytes:
    """A chunk of a PNG with its checksum."""
    checksum = struct.pack(">I", zlib.crc32(name + content))
    return struct.pack(">I", len(content)) + name + content + checksum


def png(width: int, height: int, rows: int = 1) -> bytes:
    """A grey PNG that claims a size and holds some black rows."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    packed = zlib.compress(bytes(rows * (min(width, 1 << 20) + 1)))
    parts = chunk(b"IHDR", header), chunk(b"IDAT", packed), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def jpeg(width: int, height: int) -> bytes:
    """A JPEG whose header claims a size."""
    content = bytearray(cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes())
    at = content.index(b"\xff\xc0")
    content[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(content)


def tiff(width: int, height: int, order: str = "<") -> bytes:
    """The header of a TIFF that claims a size."""
    start = b"II*\0" if order == "<" else b"MM\0*"
    entries = [(256, width), (257, height), (258, 8)]
    packed = b"".join(struct.pack(order + "HHII", tag, 4, 1, value) for tag, value in entries)
    return start + struct.pack(order + "IH", 8, len(entries)) + packed + bytes(4)


def bmp(width: int, height: int) -> bytes:
    """The header of a BMP that claims a size."""
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
def test_an_image_of_too_many_pixels_is_not_decoded(kind: str, tmp_path: Path) -> None:
    (tmp_path / "left.png").write_bytes(HUGE[kind])
    line = refusal(lambda: read_image(tmp_path / "left.png"))
    assert line is not None
    assert "too many pixels" in line


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp", ".pgm", ".ppm"])
def test_the_size_is_that_of_the_decoded_image(suffix: str) -> None:
    colour = (23, 31, 3) if suffix == ".ppm" else (23, 31)
    done, content = cv2.imencode(suffix, np.zeros(colour, np.uint8))
    assert done
    assert stated_size(content.tobytes()) == (31, 23)


def test_more_pixels_are_read_if_the_settings_allow_them(pair: tuple[Path, Path]) -> None:
    few = ("--set", "source.max_megapixels=0.001")
    assert_refused(run("disparity", *pair, *few, "--out", "out"), "left.png", "max_megapixels")
    assert not Path("out").exists()


def test_the_memory_limit_bounds_the_pixels(pair: tuple[Path, Path]) -> None:
    for path in pair:
        write_image(path, np.zeros((250, 250), np.uint8))
    small = ("--set", "memory.limit_mb=1")
    assert_refused(run("disparity", *pair, *small, "--out", "out"), "left.png", "pixels")


def make_pipe(path: Path) -> None:
    os.mkfifo(path)


def link_to_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def link_to_itself(path: Path) -> None:
    path.symlink_to(path.name)


def link_to_nothing(path: Path) -> None:
    path.symlink_to("nothing")


SPECIAL: Final[dict[str, Callable[[Path], None]]] = {
    "a pipe": make_pipe,
    "a device": link_to_device,
    "a folder": Path.mkdir,
    "a link to itself": link_to_itself,
    "a link to nothing": link_to_nothing,
}
COMMANDS: Final[dict[str, tuple[str, ...]]] = {
    "pair": ("pair", "FILE", "right.png", "--calib", "rig.yaml"),
    "pair, right": ("pair", "left.png", "FILE", "--calib", "rig.yaml"),
    "pair, calibration": ("pair", "left.png", "right.png", "--calib", "FILE"),
    "pair, truth": ("pair", "left.png", "right.png", "--calib", "rig.yaml", "--truth", "FILE"),
    "disparity": ("disparity", "FILE", "right.png"),
    "disparity, configuration": ("disparity", "left.png", "right.png", "--config", "FILE"),
    "rectify": ("rectify", "FILE", "right.png"),
    "map": ("map", "FILE"),
    "audit": ("audit", "FILE"),
    "mesh": ("mesh", "FILE"),
    "occupancy": ("occupancy", "FILE"),
    "capture": ("capture", "FILE", "right.png", "--out", "out", "--frames", "1"),
    "calibrate": ("calibrate", "FILE", "right.png", "--board", "chess:9x6:25mm", "--out", "c.yaml"),
    "evaluate trajectory": ("evaluate", "trajectory", "FILE", "FILE"),
    "evaluate disparity": ("evaluate", "disparity", "FILE", "FILE"),
    "evaluate map": ("evaluate", "map", "FILE", "FILE"),
    "evaluate occupancy": ("evaluate", "occupancy", "FILE"),
    "evaluate middlebury": ("evaluate", "middlebury", "FILE"),
    "paper": ("paper", "FILE"),
}


@pytest.mark.parametrize("kind", SPECIAL)
@pytest.mark.parametrize("command", COMMANDS)
def test_what_is_no_regular_file_is_refused(
    command: str, kind: str, pair: tuple[Path, Path]
) -> None:
    Path("rig.yaml").write_text(OURS)
    SPECIAL[kind](Path("odd.png"))
    before = sorted(path.name for path in Path().iterdir())
    ended = run(*(word.replace("FILE", "odd.png") for word in COMMANDS[command]))
    assert_refused(ended, "odd.png")
    assert sorted(path.name for path in Path().iterdir()) == before


@pytest.mark.parametrize(
    "content",
    [
        b"Pf " + b"9" * 5000 + b" 1 -1\n",
        b"Pf 1 " + b"9" * 5000 + b" -1\n",
        b"Pf 99999999 99999999 -1\n" + bytes(100),
        b"Pf 1 1 " + b"9" * 5000 + b"\n" + bytes(4),
        b"Pf 1 1 1e-999\n" + bytes(4),
        b"Pf 1 1 nan\n" + bytes(4),
        b"Pf 1 1 1e+e\n" + bytes(4),
        b"Pf 0 5 -1\n" + bytes(4),
        b"Pf -1 -1 -1\n" + bytes(4),
        b"Pf\n1 1\n-1.0\n" + bytes(3),
        b"PF 1 1 -1\n" + bytes(12),
        b"Pf",
        b"P",
        "Pf \u0661 \u0661 -1\n".encode() + bytes(4),
    ],
    ids=lambda content: content[:20].decode(errors="replace").strip()[:18],
)
def test_a_hostile_pfm_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "d.pfm").write_bytes(content)
    line = refusal(lambda: read_pfm(tmp_path / "d.pfm"))
    assert line is not None
    assert "d.pfm" in line


@pytest.mark.parametrize(
    "content",
    [
        b"P5 " + b"9" * 5000 + b" 1 255\n",
        b"P5 1 " + b"9" * 5000 + b" 255\n",
        b"P5 1 1 " + b"9" * 5000 + b"\n0",
        b"P5 0 0 255\n",
        b"P5 -1 1 255\n0",
        b"P5 1 1 0\n0",
        b"P5 1 1 99999\n0",
        b"P5 1",
        b"P2 2 2 255\nx y z w",
        b"P2 2 2 255\n1 2 3 99999999999999999999",
        b"P4 8 8\n" + bytes(8),
        b"P7\nWIDTH 1\n",
        "P5 \u0661 \u0661 255\n0".encode(),
        b"BM",
        b"BM" + b"\xff" * 60,
        b"II*\0" + b"\xff" * 60,
        b"MM\0*",
        b"\x89PNG\r\n\x1a\n",
        b"\x89PNG\r\n\x1a\n" + b"\xff" * 60,
        b"\xff\xd8\xff",
        b"\xff\xd8" + b"\xff" * 60,
        b"\xff\xd8\xff\xe0\xff\xff",
        b"\0" * 1000,
        b"GIF89a" + bytes(20),
        b"%PDF-1.4",
    ],
    ids=lambda content: repr(content[:12])[2:-1],
)
def test_a_hostile_header_of_an_image_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "i.png").write_bytes(content)
    line = refusal(lambda: read_image(tmp_path / "i.png"))
    if line is not None:
        assert "i.png" in line


def test_every_truncation_of_an_image_is_refused(tmp_path: Path) -> None:
    image = np.random.default_rng(3).integers(0, 255, (7, 9), np.uint8)
    for suffix in (".png", ".jpg", ".pgm", ".tiff", ".bmp"):
        content = cv2.imencode(suffix, image)[1].tobytes()
        for length in range(1, len(content) - 16, 7):
            (tmp_path / "i.png").write_bytes(content[:length])
            with warnings.catch_warnings(record=True) as said:
                assert refusal(lambda: read_image(tmp_path / "i.png")) is not None, (suffix, length)
            assert said == []


def test_every_truncation_of_a_disparity_is_refused(tmp_path: Path) -> None:
    write_pfm(tmp_path / "d.pfm", np.ones((4, 5), np.float32))
    content = (tmp_path / "d.pfm").read_bytes()
    for length in range(len(content)):
        (tmp_path / "d.pfm").write_bytes(content[:length])
        assert refusal(lambda: read_pfm(tmp_path / "d.pfm")) is not None, length


@pytest.mark.parametrize("size", [(1, 1), (1, 48), (48, 1), (2, 2), (3, 1000), (1000, 3)])
@pytest.mark.parametrize("matcher", ["sad", "sgm", "opencv-bm", "opencv-sgbm"])
@pytest.mark.parametrize("command", ["disparity", "pair", "rectify"])
def test_a_tiny_image_is_matched_or_refused(
    command: str, matcher: str, size: tuple[int, int], here: Path
) -> None:
    image = np.random.default_rng(1).integers(0, 255, size, np.uint8)
    for name in ("left.png", "right.png"):
        write_image(here / name, image)
    (here / "rig.yaml").write_text(
        OURS.replace("width_px: 48", f"width_px: {size[1]}").replace(
            "height_px: 32", f"height_px: {size[0]}"
        )
    )
    more = () if command == "rectify" else ("--matcher", matcher)
    calib = () if command == "disparity" else ("--calib", "rig.yaml")
    ended = run(command, "left.png", "right.png", *calib, *more, "--quiet", "--out", "out")
    assert ended.code in {0, 1}
    if ended.code == 1:
        assert_refused(ended)
        assert not Path("out").exists()
