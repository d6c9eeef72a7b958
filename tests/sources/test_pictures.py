"""Pictures as people have them: 16 bits, mosaics, videos in bags, parts of sensors, EXIF."""

import struct
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import CalibrationError, FormatError, ReconError, SourceError
from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import RectifiedCamera, StereoCalibration
from recon.io.images.image import Levels, eight_bits, find_levels, pixels_of_ros_image
from recon.io.images.packets import codec_of
from recon.io.ros.contents import VIDEOS
from recon.look.sample import measure_mosaic
from recon.sources.one_pair import read_pair_input
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from recon.stereo.frame import FrameReconstructor, StereoSettings
from tests.sources import drives
from tests.sources.bags import TOPICS, Recording, recorder
from tests.sources.drives import CAMERA

rosbags = pytest.importorskip("rosbags.typesys", reason="extra ros")
START_NS = drives.EPOCH_S * 10**9
RAW = ("/rig/left/image_raw", "/rig/right/image_raw")
Make = Callable[[Any, int, np.ndarray], Any]


def scene(seed: int = 0, shape: tuple[int, int] = (32, 64)) -> np.ndarray:
    """Smooth texture of all grey levels, as in photographs."""
    noise = np.random.default_rng(seed).uniform(0, 255, shape).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.rint(cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX)).astype(np.uint8)


def write(
    folder: Path,
    images: Sequence[np.ndarray],
    make: Make,
    camera: RectifiedCamera = CAMERA,
    topics: tuple[str, str] = TOPICS,
    kind: str = "mcap",
    **infos: Any,
) -> Path:
    """Write a bag whose left and right images are equal; ``make`` makes their messages."""
    with recorder(folder, Recording(kind)) as bag:
        for name, fields in VIDEOS.items():
            bag.store.register(rosbags.get_types_from_msg(fields, name))
        for number, image in enumerate(images):
            stamp = START_NS + number * 10**8
            bag.camera_infos(stamp, camera, topics, **infos)
            for topic in topics:
                bag.write(topic, stamp, make(bag, stamp, image))
    return Recording(kind).path(folder)


def sixteen(encoding: str = "mono16") -> Make:
    def make(bag: Any, stamp: int, values: np.ndarray) -> Any:
        return bag.make(
            "sensor_msgs/Image", header=bag.header(stamp), height=values.shape[0],
            width=values.shape[1], encoding=encoding, is_bigendian=0, step=2 * values.shape[1],
            data=np.frombuffer(values.astype("<u2").tobytes(), np.uint8),
        )  # fmt: skip

    return make


def compressed(form: str, suffix: str = ".png") -> Make:
    def make(bag: Any, stamp: int, values: np.ndarray) -> Any:
        data = values if values.ndim == 1 else cv2.imencode(suffix, values)[1].ravel()
        return bag.make(
            "sensor_msgs/CompressedImage", header=bag.header(stamp), format=form, data=data
        )

    return make


@pytest.mark.parametrize(
    ("scale", "levels"),
    [((16, 7), Levels(0, 4095)),  # of 12 bits
     ((256, 255), Levels(0, 65535)),  # the same in the upper bits
     ((1, 0), Levels(0, 255))],
)  # fmt: skip
@pytest.mark.parametrize("make", [sixteen(), sixteen("16UC1"), compressed("16UC1; png compressed")])
def test_deep_images_of_a_bag_are_read_as_those_of_files(tmp_path, scale, levels, make):
    images = [scene(seed).astype(np.uint16) * scale[0] + scale[1] for seed in range(3)]
    bag = open_source(write(tmp_path / "bag", images, make))
    folder = tmp_path / "files"
    for number, image in enumerate(images):
        for side in ("left", "right"):
            (folder / side).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / side / f"{number}.png"), image)
    drives.write_calib(folder, CAMERA)
    for read, filed, given_ in zip(bag, open_source(folder), range(3), strict=True):
        np.testing.assert_array_equal(read.left, filed.left)
        np.testing.assert_array_equal(read.right, filed.right)
        # A level of eight bits, and its rounding.
        assert np.abs(read.left.astype(int) - scene(given_)).max() <= 1
    assert bag.levels == levels


def test_thermal_images_use_all_levels_and_stay_as_bright_from_frame_to_frame(tmp_path):
    """14 bits of which 500 are used; a pixel is stuck at its end."""
    images = [7300 + 2 * scene(seed).astype(np.uint16) for seed in range(3)]
    images[1][3, 5] = 16383
    source = open_source(write(tmp_path, images, sixteen("16UC1")))
    read = [pair.left.astype(int) for pair in source]
    assert 200 < np.ptp(read[0]) < 256  # with room on either side
    same = images[0] == images[2]
    np.testing.assert_array_equal(read[0][same], read[2][same])
    # 255 levels for 510 values of which every other is used, and room of a quarter of these.
    assert len(np.unique(read[0])) >= 0.75 * len(np.unique(images[0]))


@given(st.integers(8, 16), st.integers(0, 2**16 - 1), st.integers(0, 2**16 - 1))
def test_levels_hold_nearly_all_pixels_and_keep_their_order(bits, one, other):
    low, high = sorted((one % 2**bits, other % 2**bits))
    values = np.linspace(low, high, 1001).astype(np.uint16).reshape(7, -1)
    levels = find_levels([values])
    assert 0 <= levels.black < levels.white <= 65535
    assert levels.white - levels.black >= 255
    beyond = ((values < levels.black) | (values > levels.white)).mean()
    assert beyond <= 0.002  # a thousandth at either end
    ordered = eight_bits(np.sort(values.ravel())[None], levels)[0].astype(int)
    assert (np.diff(ordered) >= 0).all()


def test_no_image_and_a_black_one_have_levels():
    assert find_levels([]) == find_levels([np.zeros((2, 2), np.uint16)]) == Levels(0, 255)
    assert find_levels([np.full((2, 2), 65535, np.uint16)]) == Levels(65280, 65535)


def mosaic(image: np.ndarray) -> np.ndarray:
    out = image.copy()
    out[::2, ::2] = out[::2, ::2] * 0.5
    out[1::2, 1::2] = out[1::2, 1::2] * 0.7
    return out


@pytest.mark.parametrize(("suffix", "limit"), [(".png", 2.0), (".jpg", 6.0)])
def test_colours_are_made_of_a_compressed_mosaic_that_is_called_so(tmp_path, suffix, limit):
    """``limit``: of the mean error, grey levels; interpolation, and JPEG of quality 95."""
    image, form = scene(), f"bayer_rggb8; {suffix[1:]} compressed "
    path = write(tmp_path, [mosaic(image)], compressed(form, suffix))
    (pair,) = open_source(path)
    assert pair.left.shape == (32, 64, 3)
    error = np.abs(pair.left[4:-4, 4:-4, 1].astype(int) - image[4:-4, 4:-4])
    assert error.mean() < limit
    already = write(tmp_path / "b", [np.dstack([image] * 3)], compressed(form))
    np.testing.assert_array_equal(next(iter(open_source(already))).left[:, :, 0], image)


def test_a_mosaic_that_nothing_names_is_told_from_photographs_and_noise():
    image, noise = scene(), np.random.default_rng(1).integers(0, 255, (64, 64)).astype(np.uint8)
    assert measure_mosaic(image) < 0.9 < measure_mosaic(noise) < 1.1 < measure_mosaic(mosaic(image))
    assert measure_mosaic(np.dstack([mosaic(image)] * 3)) > 1.1
    assert measure_mosaic(np.zeros((32, 32), np.uint8)) == 0.0


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
def test_planes_of_grey_and_colours_are_read(encoding):
    rgb = np.dstack([cv2.resize(scene(n, (8, 16)), (64, 32)) for n in range(3)])
    y, u, v = (plane.reshape(-1) for plane in _planes(rgb))
    colours = np.stack([u, v] if encoding == "nv12" else [v, u], 1).ravel()
    data = np.concatenate([y, colours])
    for step in (64, 96):  # some write 1.5 bytes a pixel
        read = pixels_of_ros_image(data, encoding, (32, 64), step)
        # Colours are those of 2x2 pixels.
        assert np.abs(read.astype(int) - rgb).mean() < 12
    for shape, size in [((31, 64), 3072), ((32, 63), 3072), ((32, 64), 3071), ((32, 64), 0)]:
        with pytest.raises(FormatError, match=r"odd size|too few bytes"):
            pixels_of_ros_image(data[:size], encoding, shape, 64)


def _planes(rgb: np.ndarray) -> list[np.ndarray]:
    flat = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420).ravel()
    return np.split(flat, [32 * 64, 32 * 64 * 5 // 4])


@pytest.mark.parametrize("encoding", ["bayer_rggb16", "rgb16", "bgr16"])
def test_deep_colours_are_read(encoding):
    values = np.full((4, 6) if encoding[0] == "b" and "y" in encoding else (4, 6, 3), 700, "<u2")
    data = np.frombuffer(values.tobytes(), np.uint8)
    read = pixels_of_ros_image(data, encoding, (4, 6), values[0].nbytes)
    assert (read.dtype, read.shape) == (np.uint16, (4, 6, 3))
    assert (read == 700).all()


def packets(images: Sequence[np.ndarray], codec: str, **options: str) -> list[np.ndarray]:
    av = pytest.importorskip("av", reason="extra video")
    context = av.CodecContext.create(codec, "w")
    context.height, context.width = images[0].shape
    context.pix_fmt, context.gop_size = "yuv420p", 4
    context.time_base, context.framerate = Fraction(1, 10), Fraction(10, 1)
    options = {"preset": "fast", "tune": "zerolatency", "crf": "5", "sc_threshold": "0"} | options
    context.options = options | {"x265-params": "log-level=none:scenecut=0"}
    found = []
    for number, image in enumerate(images):
        frame = av.VideoFrame.from_ndarray(np.dstack([image] * 3), format="rgb24")
        frame = frame.reformat(format="yuv420p")
        frame.pts = number
        found += [bytes(one) for one in context.encode(frame)]
    found += [bytes(one) for one in context.encode(None)]
    return [np.frombuffer(one, np.uint8) for one in found]


def foxglove(form: str) -> Make:
    return lambda bag, stamp, data: bag.store.types["foxglove_msgs/msg/CompressedVideo"](
        timestamp=bag.header(stamp).stamp, frame_id="cam", data=data, format=form
    )


def transported(form: str) -> Make:
    return lambda bag, stamp, data: bag.store.types["ffmpeg_image_transport_msgs/msg/FFMPEGPacket"](
        bag.header(stamp), 64, 64, form, 0, 0, False, data
    )


VIEW = RectifiedCamera(60.0, 31.5, 31.5, 31.5, 0.5, 64, 64)
FRAMES = [scene(seed, (64, 64)) for seed in range(11)]


@pytest.mark.parametrize(
    ("kind", "codec", "make"),
    [("mcap", "libx264", foxglove("h264")), ("ros1", "libx264", foxglove("h264")),
     ("ros2", "libx265", compressed("h265")), ("mcap", "libx264", transported("libx264"))],
)  # fmt: skip
def test_a_video_in_a_bag_is_read_from_its_first_keyframe_on(tmp_path, kind, codec, make):
    """The recorder was started within the first group of four."""
    left = packets(FRAMES, codec)[1:]
    source = open_source(write(tmp_path, left, make, VIEW, kind=kind))
    assert len(source) == 7
    said = [f"{topic}: 3 images before the first keyframe of the video" for topic in TOPICS]
    assert [line.partition(": left out")[0] for line in source.warnings()] == said
    for start in (0, 2, 5):  # also within a group
        for pair in source.frames(start):
            wanted = FRAMES[4 + pair.index].astype(int)
            # A lossy codec, of a smooth image.
            assert np.abs(pair.left[:, :, 0] - wanted).mean() < 4
            np.testing.assert_array_equal(pair.left, pair.right)
    part = open_source(source.bag.paths[0], settings=SourceSettings(start=3, stride=3))
    np.testing.assert_array_equal(next(part.frames(1)).left, next(source.frames(6)).left)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [(lambda all_: all_[1:4], r"no keyframe \(got 3 messages"),
     (lambda all_: [all_[0], all_[0][:0] + 7, *all_[1:]], "message 1.*cannot be decoded"),
     (lambda all_: [all_[0], np.frombuffer(b"\0\0\0\1" + b"\xff" * 99, np.uint8)],
      "message 1.*cannot be decoded"),
     (lambda all_: [np.frombuffer(b"\0\0\0\1\x67" + b"\0" * 50, np.uint8)], "cannot be decoded"),
     (lambda all_: [np.zeros(0, np.uint8)] * 3, "no keyframe")],
)  # fmt: skip
def test_a_damaged_video_in_a_bag_is_one_line(tmp_path, spoil, message, capfd):
    path = write(tmp_path, spoil(packets(FRAMES, "libx264")), foxglove("h264"), VIEW)
    with pytest.raises(ReconError, match=message) as caught:
        list(open_source(path))
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_codecs_are_known_by_the_names_of_their_encoders():
    assert [codec_of(name) for name in ("libx264", "h264_nvenc", "H265", "hevc_vaapi")] == [
        "h264", "h264", "hevc", "hevc"]  # fmt: skip
    assert codec_of("mono8; jpeg compressed ") is codec_of("av1") is None


@pytest.mark.parametrize("topics", [TOPICS, RAW])
@pytest.mark.parametrize(
    ("binning", "part", "size"),
    [((2, 2), (0, 0, 0, 0), (32, 16)), ((0, 1), (8, 4, 48, 24), (48, 24)),
     ((2, 2), (8, 4, 48, 24), (24, 12)), ((2, 2), (0, 0, 0, 0), (64, 32))],
)  # fmt: skip
def test_a_part_of_a_sensor_and_binned_pixels_see_what_the_whole_sees(
    tmp_path, topics, binning, part, size
):
    """The last image is as large as is stated: its driver has a CameraInfo of it."""
    image = np.zeros(size[::-1], np.uint8)
    path = write(tmp_path, [image], compressed("mono8"), topics=topics, binning=binning, part=part)
    source = open_source(path)
    camera = source.calibration
    assert (camera.width_px, camera.height_px) == size
    whole = size == (64, 32)
    by = np.ones(2) if whole else np.maximum(binning, 1)
    # The corner of the part, half a pixel from the centre of its first one, has one direction.
    corner = np.array([-0.5, -0.5]) if whole else np.array(part[:2]) - 0.5
    expected = (corner - [CAMERA.cx_px, CAMERA.cy_px]) / CAMERA.focal_px
    focal = np.array([camera.matrix[0, 0], camera.matrix[1, 1]])
    np.testing.assert_allclose((-0.5 - camera.matrix[:2, 2]) / focal, expected, rtol=1e-12)
    np.testing.assert_allclose(focal, CAMERA.focal_px / by, rtol=1e-12)
    assert camera.baseline_m == pytest.approx(CAMERA.baseline_m, rel=1e-12)
    assert len(list(source)) == 1


def test_a_region_beyond_the_sensor_is_refused(tmp_path):
    image = np.zeros((24, 48), np.uint8)
    path = write(tmp_path, [image], compressed("mono8"), part=(20, 4, 48, 24))
    with pytest.raises(CalibrationError, match=r"beyond the image .*48x24 at \(20, 4\).*64x32"):
        open_source(path)


@pytest.mark.parametrize("topics", [TOPICS, RAW])
@pytest.mark.parametrize("turn", [np.zeros(3), np.array([0.01, 0.02, -0.01])])
def test_the_baseline_of_cameras_calibrated_one_by_one_is_that_of_static_transforms(
    tmp_path, topics, turn
):
    T_base_left = make_transform(exp_so3([0.1, -1.2, 0.3]), np.array([1.0, 0.2, 0.5]))
    T_right_left = make_transform(exp_so3(turn), np.array([-0.12, 0.001 * turn.any(), 0.0]))
    for frames in (("left", "right"), ("left", "left"), ("left", "gone")):
        folder = tmp_path / "-".join(frames)
        with recorder(folder, Recording("ros1")) as bag:
            bag.write("/tf_static", START_NS, bag.transforms(
                bag.transform(START_NS, "base_link", "left", T_base_left),
                bag.transform(START_NS, "base_link", "right", T_base_left @ invert(T_right_left)),
            ))  # fmt: skip
            bag.camera_infos(START_NS, CAMERA, topics, P=_P_of_one())
            for topic, frame in zip(topics, frames, strict=True):
                message = bag.image(START_NS, np.zeros((32, 64), np.uint8))
                message.header.frame_id = frame
                bag.write(topic, START_NS, message)
        if frames[1] != "right":
            with pytest.raises(CalibrationError, match=r"no baseline .*no static transform"):
                open_source(folder / "drive.bag")
            continue
        rig = open_source(folder / "drive.bag").calibration
        assert isinstance(rig, StereoCalibration if turn.any() else RectifiedCamera)
        if isinstance(rig, StereoCalibration):
            np.testing.assert_allclose(rig.T_right_left, T_right_left, atol=1e-12)
        assert rig.baseline_m == pytest.approx(np.linalg.norm(T_right_left[:3, 3]), rel=1e-9)


def _P_of_one() -> list[float]:
    return [60.0, 0, 31.5, 0, 0, 60.0, 15.5, 0, 0, 0, 1, 0]


def tagged(image: np.ndarray, tag: int | None) -> bytes:
    """A JPEG whose EXIF data have an orientation."""
    content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    if tag is None:
        return content
    exif = b"Exif\0\0II*\0" + struct.pack("<IHHHIII", 8, 1, 0x0112, 3, 1, tag, 0)
    return content[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + content[2:]


def write_tagged(folder: Path, tags: Sequence[int | None], size: tuple[int, int] | None) -> Path:
    """Write a drive of images 64x32 as stored, whose calibration is of a size, or of any."""
    for number, tag in enumerate(tags):
        for side in ("left", "right"):
            path = folder / side / f"{number}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(tagged(scene(number), tag))
    width, height = size or (64, 32)
    camera = RectifiedCamera(60.0, (width - 1) / 2, (height - 1) / 2, (width - 1) / 2, 0.5,
                             width, height)  # fmt: skip
    if size is not None:
        drives.write_calib(folder, camera)
    return folder


@pytest.mark.parametrize(
    ("tag", "size", "taken"),
    [(6, (64, 32), "stored"), (6, (32, 64), "turned"), (8, (32, 64), "turned"),
     (5, (32, 64), "turned"), (6, (200, 100), None), (1, (64, 32), ""), (None, (64, 32), ""),
     (99, (64, 32), ""), (0, (64, 32), "")],
)  # fmt: skip
def test_images_are_turned_where_the_calibration_fits_them_turned(tmp_path, tag, size, taken):
    path = write_tagged(tmp_path, [tag, tag], size)
    if taken is None:
        with pytest.raises(CalibrationError, match="another size"):
            open_source(path)
        return
    source = open_source(path)
    told = [f"images have EXIF orientation {tag}: taken as {taken}, as the calibration has"]
    assert [line.partition(" their size")[0] for line in source.warnings()] == told * bool(taken)
    image = next(source.frames(1)).left.astype(int)
    turns = {"turned": {6: -1, 8: 1, 5: 0}.get(tag or 0, 0)}.get(taken, 0)
    wanted = scene(1).T if (tag, taken) == (5, "turned") else np.rot90(scene(1), turns)
    assert image.shape == size[::-1] == wanted.shape
    # JPEG of the best quality.
    assert np.abs(image - wanted).max() <= 3
    pair = read_pair_input(path / "left" / "1.jpg", path / "right" / "1.jpg", path / "calib.txt")
    np.testing.assert_array_equal(pair.pair.left, next(source.frames(1)).left)
    assert pair.notes == tuple(source.warnings())


@pytest.mark.parametrize("tag", [2, 3, 4])
def test_what_no_size_decides_is_refused_until_it_is_said(tmp_path, tag):
    path = write_tagged(tmp_path, [tag, 1], (64, 32))
    message = rf"0\.jpg: .*got {tag}.*--set source.orientation=stored, or =turned"
    with pytest.raises(SourceError, match=message):
        open_source(path)
    files = [path / side / "0.jpg" for side in ("left", "right")]
    for calibration in (path / "calib.txt", None):
        with pytest.raises(SourceError, match=message):
            read_pair_input(files[0], files[1], calibration)
    flipped = {2: np.fliplr, 3: lambda one: np.rot90(one, 2), 4: np.flipud}[tag]
    for how, turn in (("stored", np.asarray), ("turned", flipped)):
        said = SourceSettings.parse({"orientation": how})
        first, second = open_source(path, settings=said)
        assert np.abs(first.left.astype(int) - turn(scene(0))).max() <= 3
        assert np.abs(second.left.astype(int) - scene(1)).max() <= 3  # by its own
        pair = read_pair_input(files[0], files[1], None, settings=said).pair
        np.testing.assert_array_equal(pair.left, first.left)


@pytest.mark.parametrize("tags", [(1, 6), (None, 3), (6, 1), (6, 8)])
def test_orientations_that_change_are_refused_in_one_line(tmp_path, tags):
    path = write_tagged(tmp_path, tags, (64, 32))
    said = r"1\.jpg: EXIF orientation .*source.orientation"
    with pytest.raises(ReconError, match=said) as caught:
        list(open_source(path))
    assert "\n" not in str(caught.value)
    right = path / "right" / "0.jpg"
    right.write_bytes(tagged(scene(0), tags[1]))
    with pytest.raises(ReconError, match=r"right.0\.jpg: EXIF orientation"):
        read_pair_input(path / "left" / "0.jpg", right, path / "calib.txt")


def test_damaged_exif_data_say_nothing(tmp_path):
    path = write_tagged(tmp_path, [6, 6], (64, 32))
    for file in path.rglob("*.jpg"):
        content = bytearray(file.read_bytes())
        at = content.index(b"II*\0")
        content[at + 4 : at + 8] = b"\xff\xff\xff\x7f"  # its directory is beyond the file
        file.write_bytes(bytes(content))
    source = open_source(path)
    assert (len(list(source)), source.warnings()) == (2, [])


@pytest.mark.slow
@pytest.mark.real
def test_a_road_is_matched_as_well_from_a_bag_of_twelve_or_fourteen_bits(recon_data, tmp_path):
    drive = open_source(recon_data / "driven" / "kitti_06_51", settings=SourceSettings(end=1))
    (pair,), found = drive, []
    plain = FrameReconstructor(drive.calibration, StereoSettings()).match(pair)[1].values
    for name, make, scale in (
        ("12", sixteen(), (16, 9)),
        ("14", sixteen("16UC1"), (2, 7300)),
        ("mosaic", compressed("bayer_rggb8; jpeg compressed ", ".jpg"), None),
    ):
        folder = tmp_path / name
        with recorder(folder, Recording("mcap")) as bag:
            bag.camera_infos(START_NS, drive.calibration)
            for topic, image in zip(TOPICS, (pair.left, pair.right), strict=True):
                grey = image if image.ndim == 2 else image[:, :, 0]
                values = mosaic(grey) if scale is None else grey.astype(np.uint16) * scale[0]
                values = values if scale is None else values + scale[1]
                bag.write(topic, START_NS, make(bag, START_NS, values))
        source = open_source(Recording("mcap").path(folder))
        (read,) = source
        values = FrameReconstructor(source.calibration, StereoSettings()).match(read)[1].values
        found.append(np.isfinite(values).mean() / np.isfinite(plain).mean())
    # The same pixels; of the mosaic half of the light is missing.
    assert min(found[:2]) > 0.98
    assert found[2] > 0.9
