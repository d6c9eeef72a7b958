"""Images, disparity maps, videos and images of ROS: what is read back, and what is refused."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from recon.core.errors import FormatError, OutputError, ShapeError
from recon.io.images.disparity import (
    fitting_scale,
    read_disparity_png,
    read_pfm,
    write_disparity_png,
    write_pfm,
)
from recon.io.images.image import (
    pixels_of_ros_image,
    read_focal_length,
    read_grey_levels,
    read_image,
    read_levels,
    write_image,
)
from recon.sources.video import open_video
from tests.sources.drives import write_video

NAN = float("nan")
SIDES = st.integers(1, 9)
SHAPES = st.one_of(st.tuples(SIDES, SIDES), st.tuples(SIDES, SIDES, st.just(3)))


def random_image(*shape: int, dtype: str = "u1") -> np.ndarray:
    top = np.iinfo(dtype).max
    return np.random.default_rng(7).integers(0, top, shape, dtype=dtype, endpoint=True)


@settings(max_examples=60)
@given(
    image=st.sampled_from(["u1", "u2"]).flatmap(lambda t: arrays(t, SHAPES)),
    suffix=st.sampled_from([".png", ".tif", ".tiff", "pnm"]),
)
def test_lossless_formats_give_back_every_level(image, suffix, tmp_path_factory):
    netpbm = ".pgm" if image.ndim == 2 else ".ppm"
    path = tmp_path_factory.getbasetemp() / f"levels{netpbm if suffix == 'pnm' else suffix}"
    write_image(path, image)
    np.testing.assert_array_equal(read_levels(path), image)


def test_channels_levels_and_the_limit_of_pixels_of_a_file(tmp_path):
    write_image(tmp_path / "red.ppm", np.full((2, 2, 3), (255, 0, 0), np.uint8))
    assert (tmp_path / "red.ppm").read_bytes().endswith(b"\xff\x00\x00" * 4)
    bgra = random_image(4, 5, 4)
    cv2.imwrite(str(tmp_path / "a.png"), bgra)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), bgra[:, :, 2::-1])
    levels = np.array([[0, 128, 129, 257, 32768, 65535]], dtype=np.uint16)
    write_image(tmp_path / "a.png", levels)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), [[0, 0, 1, 1, 128, 255]])
    write_image(tmp_path / "a.png", random_image(4, 5))
    assert read_image(tmp_path / "a.png", max_megapixels=20e-6).shape == (4, 5)
    with pytest.raises(FormatError, match=r"too many pixels .*got 5x4"):
        read_image(tmp_path / "a.png", max_megapixels=19e-6)


def test_grey_in_three_equal_channels_is_grey_and_colours_are_refused(tmp_path):
    grey = random_image(4, 5)
    write_image(tmp_path / "grey.png", np.repeat(grey[:, :, None], 3, axis=2))
    np.testing.assert_array_equal(read_grey_levels(tmp_path / "grey.png"), grey)
    write_image(tmp_path / "rgb.png", random_image(4, 5, 3))
    with pytest.raises(FormatError, match=r"rgb\.png: image is in colour"):
        read_grey_levels(tmp_path / "rgb.png")


@pytest.mark.parametrize("shape", [(16, 18), (16, 18, 3)])
def test_a_bmp_is_read_whole_or_not_at_all(tmp_path, shape):
    pixels = random_image(*shape)
    content = cv2.imencode(".bmp", pixels if pixels.ndim == 2 else pixels[:, :, ::-1])[1].tobytes()
    path = tmp_path / "a.bmp"
    path.write_bytes(content)
    np.testing.assert_array_equal(read_image(path), pixels)
    for cut in (1, 40, len(content) - 30):
        path.write_bytes(content[:-cut])
        with pytest.raises(FormatError, match=r"a\.bmp: BMP image is truncated"):
            read_image(path)


def test_a_flipped_bit_of_a_png_and_a_cut_behind_the_preview_of_a_jpeg_are_seen(tmp_path):
    path = tmp_path / "a.png"
    write_image(path, random_image(20, 20))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(FormatError, match=r"damaged \(got checksum of chunk b'IDAT' differs\)"):
        read_image(path)
    path = tmp_path / "a.jpg"
    write_image(path, random_image(40, 40))
    content, preview = path.read_bytes(), b"\xff\xd8preview\xff\xd9"
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
def test_pgm_is_read_binary_and_ascii_with_comments(tmp_path, content):
    (tmp_path / "a.pgm").write_bytes(content)
    np.testing.assert_array_equal(read_image(tmp_path / "a.pgm"), [[97, 98], [99, 100]])


def test_a_damaged_tiff_is_reported_by_the_error_alone_and_floats_are_refused(tmp_path, capfd):
    path = tmp_path / "a.tif"
    write_image(path, random_image(60, 80))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(FormatError, match=r"a\.tif: image cannot be decoded"):
        read_image(path)
    assert capfd.readouterr() == ("", "")
    cv2.imwrite(str(path), np.ones((3, 3), dtype=np.float32))
    with pytest.raises(FormatError, match=r"pixel type.*got float32, expected 8 or 16 bits"):
        read_image(path)


@pytest.mark.parametrize(
    ("name", "image", "error"),
    [
        ("a.xyz", random_image(3, 3), OutputError),
        ("a.pgm", random_image(3, 3, 3), OutputError),
        ("a.ppm", random_image(3, 3), OutputError),
        ("a.jpg", random_image(3, 3, dtype="u2"), OutputError),
        ("a.png", random_image(3, 3).astype(np.float32), ShapeError),
        ("a.png", random_image(3, 3, 4), ShapeError),
        ("a.png", random_image(0, 3), ShapeError),
    ],
)
def test_what_a_format_cannot_hold_is_refused_and_nothing_is_written(tmp_path, name, image, error):
    with pytest.raises(error):
        write_image(tmp_path / name, image)
    assert list(tmp_path.iterdir()) == []


FOCAL, FOCAL_35, WIDTH, RESOLUTION, UNIT = 0x920A, 0xA405, 0xA002, 0xA20E, 0xA210
MM_5 = IFDRational(5)


@pytest.mark.parametrize(
    ("tags", "focal_px", "basis"),
    [
        ({FOCAL_35: 28}, 28 * 500 / math.hypot(36, 24), "28 mm as 35 mm equivalent"),
        # 5 mm at 200 pixels per millimetre, at half of the recorded width.
        ({FOCAL: MM_5, RESOLUTION: IFDRational(2000), UNIT: 3, WIDTH: 800, FOCAL_35: 28},
         500.0, "5 mm and the pixels of the sensor"),
        ({}, None, ""),
        ({FOCAL: MM_5}, None, ""),
        ({FOCAL_35: 0}, None, ""),
        ({FOCAL: IFDRational(5, 0)}, None, ""),
    ],
)  # fmt: skip
def test_the_focal_length_of_a_photo_is_that_of_its_sensor_else_of_its_diagonal(
    tmp_path, tags, focal_px, basis
):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.new("RGB", (400, 300)).save(tmp_path / "a.jpg", exif=exif)
    found = read_focal_length(tmp_path / "a.jpg", 400, 300)
    if focal_px is None:
        assert found is None
    else:
        assert (found.focal_px, found.basis) == (pytest.approx(focal_px), basis)


DISPARITIES = st.tuples(st.integers(1, 6), st.integers(1, 6))


@settings(max_examples=50)
@given(arrays(np.float32, DISPARITIES, elements=st.floats(-1e6, 1e6, width=32) | st.just(NAN)))
def test_pfm_gives_back_every_bit(tmp_path_factory, values):
    path = tmp_path_factory.getbasetemp() / "values.pfm"
    write_pfm(path, values)
    read = read_pfm(path)
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, values)


def test_unknown_disparities_of_pfm_kittis_and_eight_bits_and_their_scales(tmp_path):
    write_pfm(tmp_path / "a.pfm", np.array([[np.nan, 1.0], [2.0, 3.0]], dtype=np.float32))
    content = (tmp_path / "a.pfm").read_bytes()
    assert content.startswith(b"Pf\n2 2\n-1.0\n")
    assert np.frombuffer(content[-16:], "<f4").tolist() == [2.0, 3.0, np.inf, 1.0]
    with pytest.raises(ShapeError, match="got float64"):
        write_pfm(tmp_path / "a.pfm", np.zeros((2, 2)))
    write_disparity_png(tmp_path / "a.png", np.array([[NAN, 0, 1, 200.5]], dtype=np.float32))
    levels = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert (levels.dtype, levels.tolist()) == (np.uint16, [[0, 1, 256, 51328]])
    write_image(tmp_path / "b.pgm", np.array([[0, 1, 240]], dtype=np.uint8))
    values = read_disparity_png(tmp_path / "b.pgm", scale=16)
    np.testing.assert_array_equal(values, np.array([[NAN, 1 / 16, 15]], "f4"))
    with pytest.raises(FormatError, match=r"b\.pgm: disparity image has 8 bits"):
        read_disparity_png(tmp_path / "b.pgm")


@pytest.mark.parametrize(
    ("order", "scale"), [("<f4", "-1"), (">f4", "1.0"), ("<f4", "-0.003922"), (">f4", "2e3")]
)
def test_both_byte_orders_are_read_and_the_magnitude_of_the_scale_changes_nothing(
    tmp_path, order, scale
):
    body = np.array([3.0, np.inf, -np.inf, 4.5], dtype=order).tobytes()
    (tmp_path / "a.pfm").write_bytes(f"Pf\n2 2\n{scale}\n".encode() + body)
    np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), [[np.nan, 4.5], [3.0, np.nan]])


LEVELS = st.floats(np.float32(0.005), 250, width=32) | st.just(NAN)


@settings(max_examples=40)
@given(arrays(np.float32, DISPARITIES, elements=LEVELS))
def test_disparity_comes_back_within_half_a_level_and_nan_as_nan(tmp_path_factory, values):
    path = tmp_path_factory.getbasetemp() / "disparity.png"
    write_disparity_png(path, values)
    read = read_disparity_png(path)
    np.testing.assert_array_equal(np.isnan(read), np.isnan(values))
    np.testing.assert_allclose(read, values, rtol=0, atol=0.5 / 256 + 1e-5)


@pytest.mark.parametrize("value", [-0.1, 256.0])
def test_what_does_not_fit_is_refused_and_not_clipped(tmp_path, value):
    with pytest.raises(OutputError, match=r"a\.png: disparity does not fit.*write PFM"):
        write_disparity_png(tmp_path / "a.png", np.array([[value, NAN]], dtype=np.float32))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("top", "scale"), [(10, 256), (255.9, 256), (256, 128), (600, 64), (NAN, 256)]
)
def test_fitting_scale_is_the_largest_that_fits(tmp_path, top, scale):
    values = np.array([[top, NAN]], dtype=np.float32)
    assert fitting_scale(values) == scale
    write_disparity_png(tmp_path / "a.png", values, scale=scale)


@pytest.fixture
def clip(tmp_path):
    greys = [np.full((16, 32), grey, np.uint8) for grey in (30, 90, 150, 210)]
    return write_video(tmp_path / "a.avi", greys, "MJPG")


def test_frames_of_some_numbers_are_decoded_and_videos_of_too_many_pixels_refused(
    clip, monkeypatch
):
    opened = open_video(clip)
    assert (opened.frames, opened.width_px, opened.height_px, opened.rate_hz) == (4, 32, 16, 10)
    picked = list(opened.pick([1, 3]))
    assert [round(float(image.mean()) / 30) for _, image in picked] == [3, 7]
    assert [image.shape for _, image in picked] == [(16, 32, 3)] * 2
    assert picked[1][0] - picked[0][0] == pytest.approx(0.2)
    with pytest.raises(FormatError, match=r"a\.avi: .*to its end \(got 4 frames, expected 4"):
        list(opened.pick([4]))
    monkeypatch.setattr("recon.sources.video.MAX_MEGAPIXELS", 512e-6)
    assert open_video(clip).frames == 4
    monkeypatch.setattr("recon.sources.video.MAX_MEGAPIXELS", 511e-6)
    with pytest.raises(FormatError, match=r"too many pixels \(got 32x16"):
        open_video(clip)


RED_GREEN_BLUE = {"r": 200, "g": 90, "b": 20}


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8"])
def test_colours_of_a_message_become_rgb(encoding):
    pixel = [{**RED_GREEN_BLUE, "a": 255}[letter] for letter in encoding[:-1]]
    image = pixels_of_ros_image(np.array(pixel * 6, np.uint8), encoding, (2, 3), 3 * len(pixel))
    np.testing.assert_array_equal(image, np.full((2, 3, 3), (200, 90, 20)))


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_image_of_one_colour_gives_that_colour(pattern):
    tile = np.array([RED_GREEN_BLUE[letter] for letter in pattern], np.uint8).reshape(2, 2)
    image = pixels_of_ros_image(np.tile(tile, (4, 4)).ravel(), f"bayer_{pattern}8", (8, 8), 8)
    np.testing.assert_array_equal(image[2:6, 2:6], np.full((4, 4, 3), (200, 90, 20)))


@pytest.mark.parametrize("big_endian", [False, True])
def test_sixteen_bits_of_a_message_are_read_in_either_order_of_bytes(big_endian):
    values = np.array([[0, 257, 65535]], ">u2" if big_endian else "<u2")
    data = np.frombuffer(values.tobytes(), np.uint8)
    image = pixels_of_ros_image(data, "mono16", (1, 3), 6, big_endian=big_endian)
    np.testing.assert_array_equal(image, [[0, 257, 65535]])


@pytest.mark.parametrize(("encoding", "order"), [("yuv422_yuy2", "yuyv"), ("yuv422", "uyvy")])
def test_a_grey_yuv_image_is_grey(encoding, order):
    data = np.array([126 if letter == "y" else 128 for letter in order * 4], np.uint8)
    image = pixels_of_ros_image(data, encoding, (2, 4), 8)
    # Video levels: 16 is black, 235 white.
    np.testing.assert_allclose(image, 255 * (126 - 16) / 219, atol=1)


def test_a_message_with_too_few_bytes_is_refused():
    with pytest.raises(FormatError, match=r"too few bytes \(got 9 bytes, 6 per row, expected 4x2"):
        pixels_of_ros_image(np.zeros(9, np.uint8), "mono8", (2, 4), 6)
    # The last row needs no padding.
    assert pixels_of_ros_image(np.zeros(10, np.uint8), "mono8", (2, 4), 6).shape == (2, 4)
