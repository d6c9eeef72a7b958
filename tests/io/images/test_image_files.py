from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from recon.core.errors import FormatError, OutputError, ShapeError
from recon.io.images.image import read_grey_levels, read_image, read_levels, write_image
from recon.io.images.image_header import read_focal_length

SHAPES = st.one_of(
    st.tuples(st.integers(1, 9), st.integers(1, 9)),
    st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(3)),
)


def random_image(*shape: int, dtype: str = "u1") -> np.ndarray:
    top = np.iinfo(dtype).max
    return np.random.default_rng(7).integers(0, top, shape, dtype=dtype, endpoint=True)


@settings(max_examples=60)
@given(
    image=st.sampled_from(["u1", "u2"]).flatmap(lambda t: arrays(t, SHAPES)),
    suffix=st.sampled_from([".png", ".tif", ".tiff", "pnm"]),
)
def test_lossless_formats_give_back_every_level(
    image: np.ndarray, suffix: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    netpbm = ".pgm" if image.ndim == 2 else ".ppm"
    path = tmp_path_factory.getbasetemp() / f"levels{netpbm if suffix == 'pnm' else suffix}"
    write_image(path, image)
    np.testing.assert_array_equal(read_levels(path), image)


def test_colours_are_red_green_blue_in_memory_and_right_in_the_file(tmp_path: Path) -> None:
    image = np.zeros((2, 2, 3), dtype=np.uint8)
    image[:, :, 0] = 255
    write_image(tmp_path / "red.ppm", image)
    assert (tmp_path / "red.ppm").read_bytes().endswith(b"\xff\x00\x00" * 4)
    np.testing.assert_array_equal(read_image(tmp_path / "red.ppm"), image)


def test_sixteen_bits_are_scaled_over_their_whole_range(tmp_path: Path) -> None:
    levels = np.array([[0, 128, 129, 257, 32768, 65535]], dtype=np.uint16)
    write_image(tmp_path / "a.png", levels)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), [[0, 0, 1, 1, 128, 255]])


def test_alpha_is_dropped(tmp_path: Path) -> None:
    bgra = random_image(4, 5, 4)
    cv2.imwrite(str(tmp_path / "a.png"), bgra)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), bgra[:, :, 2::-1])


def test_jpeg_is_read_close_to_what_was_written(tmp_path: Path) -> None:
    ramp = np.tile(np.arange(0, 256, 4, dtype=np.uint8), (32, 1))
    write_image(tmp_path / "a.jpg", ramp)
    # 8 levels: a smooth ramp at OpenCV's default quality of 95.
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - ramp).max() <= 8


def test_grey_stored_as_three_equal_channels_is_grey_and_colours_are_refused(
    tmp_path: Path,
) -> None:
    grey = random_image(4, 5)
    write_image(tmp_path / "grey.png", np.repeat(grey[:, :, None], 3, axis=2))
    np.testing.assert_array_equal(read_grey_levels(tmp_path / "grey.png"), grey)
    write_image(tmp_path / "rgb.png", random_image(4, 5, 3))
    with pytest.raises(FormatError, match=r"rgb\.png: image is in colour"):
        read_grey_levels(tmp_path / "rgb.png")


@pytest.mark.parametrize("shape", [(16, 18), (16, 18, 3)])
def test_a_bmp_is_read_whole_or_not_at_all(tmp_path: Path, shape: tuple[int, ...]) -> None:
    pixels = random_image(*shape)
    content = cv2.imencode(".bmp", pixels if pixels.ndim == 2 else pixels[:, :, ::-1])[1].tobytes()
    path = tmp_path / "a.bmp"
    path.write_bytes(content)
    np.testing.assert_array_equal(read_image(path), pixels)
    for cut in (1, 40, len(content) - 30):
        path.write_bytes(content[:-cut])
        with pytest.raises(FormatError, match=r"a\.bmp: BMP image is truncated"):
            read_image(path)


def test_a_flipped_bit_in_a_png_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    write_image(path, random_image(20, 20))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(FormatError, match=r"damaged \(got checksum of chunk b'IDAT' differs\)"):
        read_image(path)


def test_a_jpeg_with_an_embedded_preview_is_still_seen_to_be_truncated(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    write_image(path, random_image(40, 40))
    content = path.read_bytes()
    preview = b"\xff\xd8preview\xff\xd9"
    segment = b"\xff\xe1" + (len(preview) + 2).to_bytes(2, "big") + preview
    path.write_bytes(content[:2] + segment + content[2:])
    assert read_image(path).shape == (40, 40)
    path.write_bytes(content[:2] + segment + content[2:-50])
    with pytest.raises(FormatError, match="no end-of-image marker"):
        read_image(path)


@pytest.mark.parametrize(
    "content",
    [b"P5\n# a comment\n2 2\n255\nabcd", b"P2\n2 2\n255\n97 98 99 100\n", b"P5 2 2 255 abcd"],
)
def test_pgm_is_read_binary_and_ascii_with_comments(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.pgm").write_bytes(content)
    np.testing.assert_array_equal(read_image(tmp_path / "a.pgm"), [[97, 98], [99, 100]])


def test_a_damaged_tiff_is_reported_by_the_error_alone(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write_image(tmp_path / "a.tif", random_image(60, 80))
    content = (tmp_path / "a.tif").read_bytes()
    (tmp_path / "a.tif").write_bytes(content[: len(content) // 2])
    with pytest.raises(FormatError, match=r"a\.tif: image cannot be decoded"):
        read_image(tmp_path / "a.tif")
    assert capfd.readouterr() == ("", "")


def test_floating_point_pixels_are_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.tif"), np.ones((3, 3), dtype=np.float32))
    with pytest.raises(FormatError, match=r"pixel type.*got float32, expected 8 or 16 bits"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("name", "image", "error"),
    [
        ("a.xyz", random_image(3, 3), OutputError),
        ("a", random_image(3, 3), OutputError),
        ("a.pgm", random_image(3, 3, 3), OutputError),
        ("a.ppm", random_image(3, 3), OutputError),
        ("a.jpg", random_image(3, 3, dtype="u2"), OutputError),
        ("a.png", random_image(3, 3).astype(np.float32), ShapeError),
        ("a.png", random_image(3, 3, 4), ShapeError),
        ("a.png", random_image(0, 3), ShapeError),
    ],
)
def test_what_a_format_cannot_hold_is_refused_and_nothing_is_written(
    tmp_path: Path, name: str, image: np.ndarray, error: type[Exception]
) -> None:
    with pytest.raises(error):
        write_image(tmp_path / name, image)
    assert list(tmp_path.iterdir()) == []


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


def test_the_limit_of_pixels_is_the_last_that_is_read(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", random_image(4, 5))
    assert read_image(tmp_path / "a.png", max_megapixels=20e-6).shape == (4, 5)
    with pytest.raises(FormatError, match=r"too many pixels .*got 5x4"):
        read_image(tmp_path / "a.png", max_megapixels=19e-6)
