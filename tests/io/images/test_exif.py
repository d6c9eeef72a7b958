"""Focal lengths of photographs, from what cameras write about them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from recon.io.images.image_header import read_focal_length

FOCAL, FOCAL_35, WIDTH, RESOLUTION, UNIT = 0x920A, 0xA405, 0xA002, 0xA20E, 0xA210


def photo(path: Path, tags: dict[int, object]) -> Path:
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.new("RGB", (400, 300)).save(path, exif=exif)
    return path


def test_the_35_mm_equivalent_refers_to_the_diagonal(tmp_path: Path) -> None:
    found = read_focal_length(photo(tmp_path / "a.jpg", {FOCAL_35: 28}), 400, 300)
    assert found is not None
    assert found.focal_px == pytest.approx(28 * 500 / math.hypot(36, 24))
    assert found.basis == "28 mm as 35 mm equivalent"


def test_the_pixels_of_the_sensor_come_first_and_follow_the_size_of_the_image(
    tmp_path: Path,
) -> None:
    tags = {FOCAL: IFDRational(5), RESOLUTION: IFDRational(2000), UNIT: 3, WIDTH: 800, FOCAL_35: 28}
    found = read_focal_length(photo(tmp_path / "a.jpg", tags), 400, 300)
    assert found is not None
    # 5 mm at 200 pixels per millimetre, at half of the recorded width.
    assert found.focal_px == pytest.approx(500)
    assert "pixels of the sensor" in found.basis


@pytest.mark.parametrize(
    "tags", [{}, {FOCAL: IFDRational(5)}, {FOCAL_35: 0}, {FOCAL: IFDRational(5, 0)}]
)
def test_unknown_focal_lengths_are_none(tmp_path: Path, tags: dict[int, object]) -> None:
    assert read_focal_length(photo(tmp_path / "a.jpg", tags), 400, 300) is None


def test_a_file_that_is_no_image_has_none(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"no image")
    assert read_focal_length(tmp_path / "a.jpg", 400, 300) is None
    assert read_focal_length(tmp_path / "none.jpg", 400, 300) is None
