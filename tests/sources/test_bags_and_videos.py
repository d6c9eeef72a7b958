"""Recordings and videos: what is chosen of them, motion beside the images, faults in one line."""

import gc
import sys
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import ReconError, SourceError
from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import RectifiedCamera, StereoCalibration
from recon.io.ros.contents import BagCameraInfo
from recon.sources.bag import read_measured
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from recon.sources.source import StereoSource
from recon.sources.topics import rig_of_messages
from recon.sources.video import VideoFile, view_size
from tests.sources import drives
from tests.sources.bags import TOPICS, Recording, bag, recorder
from tests.sources.drives import CAMERA

pytest.importorskip("rosbags", reason="extra ros")


KINDS = ["ros1", "ros2", "mcap"]
START_NS = drives.EPOCH_S * 10**9
GREY = np.zeros((32, 64), np.uint8)


def fails(path: Path, message: str, settings: SourceSettings | None = None) -> None:
    with pytest.raises(ReconError, match=message) as caught:
        list(open_source(path, settings=settings))
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value) or path.name in str(caught.value)


def halve(path: Path, ratio: float = 0.5) -> Path:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * ratio)])
    return path


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("ratio", [0.0, 0.001, 0.3, 0.9])
def test_a_cut_recording_is_one_line(noise, tmp_path, kind, ratio):
    path = bag(kind=kind)(noise, CAMERA, tmp_path)
    halve(next(path.glob("*.db3")) if kind == "ros2" else path, ratio)
    fails(path, "recording cannot be read.*reindex")


@pytest.mark.parametrize("kind", KINDS)
def test_a_drive_that_is_given_up_closes_its_recording(noise, tmp_path, kind, monkeypatch):
    """As where an image has another size than the CameraInfo; SQLite is locked while it is read."""
    lost: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda one: lost.append(one.exc_value))
    source = open_source(bag(kind=kind)(noise, CAMERA, tmp_path))
    for _ in range(3):
        frames = source.frames()
        loop = [frames, next(frames)]  # only the collector of garbage finds it
        loop.append(loop)
        del frames, loop
        gc.collect()
    assert lost == []


def test_a_recording_without_an_index_is_one_line(noise, tmp_path):
    # A recorder that was killed leaves the place of the index at 0.
    path = bag(kind="ros1")(noise, CAMERA, tmp_path)
    content = path.read_bytes()
    at = content.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(content[:at] + bytes(8) + content[at + 8 :])
    fails(path, "recording cannot be read.*not indexed.*rosbag reindex")


@pytest.mark.parametrize("kind", KINDS)
def test_stamps_out_of_order_have_a_line_and_place(noise, tmp_path, kind):
    with recorder(tmp_path, Recording(kind)) as made:
        for number, pair in enumerate([*noise[:5], noise[6], noise[5], *noise[7:]]):
            for topic, image in zip(TOPICS, (pair.left, pair.right), strict=True):
                made.write(topic, number * 10**8, made.image(drives.stamp_ns(pair), image))
    path = next(p for p in tmp_path.rglob("*") if p.suffix in {".bag", ".mcap", ".db3"})
    fails(path, r"image_rect, image 6: timestamps are out of order")


@pytest.mark.parametrize(("how", "settings", "message"), [
    ({}, {"left": "/front/image", "right": TOPICS[1]},
     r"no such image topic \(got /front/image, expected .*image_rect \(12\)"),
    ({"topics": ("/front/image", "/rear/image")}, {},
     r"no image topics of a left and a right camera.*/front/image \(12\), /rear/image"),
    ({"info": False}, {}, "no calibration of both cameras.*--calib"),
    ({"encoding": "32FC1"}, {}, "message 0: image encoding is not supported.*got 32FC1"),
])  # fmt: skip
def test_what_a_recording_lacks_is_said_with_what_it_has(noise, tmp_path, how, settings, message):
    path = bag(kind="ros1", **how)(noise, CAMERA, tmp_path)
    fails(path, message, SourceSettings(**settings))


def test_topics_and_calibration_can_be_named(noise, tmp_path):
    names = ("/front/image", "/rear/image")
    path = bag(kind="mcap", topics=names, info=False)(noise, CAMERA, tmp_path)
    calib = str(drives.write_calib(tmp_path / "calibration", CAMERA))
    settings = SourceSettings(left=names[0], right=names[1], calibration=calib)
    source = open_source(path, settings=settings)
    assert (len(list(source)), source.files[0]) == (12, Path(calib))


@pytest.mark.parametrize("others", [20, 21])
def test_rectified_topics_are_taken_and_a_few_others_named(tmp_path, others):
    raw = ("/stereo/left/image_raw", "/stereo/right/image_raw")
    with recorder(tmp_path, Recording("ros1")) as made:
        for topics in (raw, TOPICS):
            made.camera_infos(START_NS, CAMERA, topics)
            for topic in topics:
                made.write(topic, START_NS, made.image(START_NS, GREY))
        for number in range(others):
            made.write(f"/wheel{number:02d}", START_NS, made.odometry(START_NS, np.eye(4)))
    description = open_source(tmp_path / "drive.bag").description
    assert f"{TOPICS[0]} and {TOPICS[1]}" in description
    assert f"also there: {raw[0]}" in description
    listed = description.partition("other topics: ")[2]
    assert ("/wheel19 …" in listed) == (others > 20)
    assert "/wheel19" in listed.partition(" (for --prior")[0]


def test_without_stamps_recording_times_are_taken(noise, tmp_path):
    path = bag(kind="ros1", stamped=False)(noise, CAMERA, tmp_path)
    # The right images are recorded 104 ms late here: nothing pairs within 10 ms ...
    source = open_source(path, settings=SourceSettings(tolerance_s=0.11))
    # ... and where the recording alone tells the times, that is said.
    assert "recording times" in source.description


@pytest.mark.parametrize("rectified", [True, False])
@pytest.mark.parametrize(
    ("focal_px", "message"),
    [(60.0, "CameraInfo has no baseline"), (0.0, "CameraInfo is of .* not calibrated")],
)
def test_messages_without_lengths_are_refused(rectified, focal_px, message):
    K = np.diag([focal_px, focal_px, 1.0])
    P = np.hstack([K, np.zeros((3, 1))])
    info = BagCameraInfo(64, 32, "plumb_bob", np.zeros(5), K, np.eye(3), P)
    with pytest.raises(ReconError, match=rf"drive\.bag: {message}.*--calib"):
        rig_of_messages(info, info, Path("drive.bag"), rectified)


@pytest.mark.parametrize("rectified", [True, False])
def test_a_vertical_rig_in_a_bag_is_called_so(rectified):
    left = np.hstack([np.diag([700.0, 700.0, 1.0]), np.zeros((3, 1))])
    right = left.copy()
    right[1, 3] = -70.0
    with pytest.raises(ReconError, match=r"a\.bag: cameras are not side by side .*vertical rig"):
        rig_of_messages(info_of(left), info_of(right), Path("a.bag"), rectified)


@pytest.mark.parametrize("side", [0, 1])
def test_a_message_whose_rotation_is_empty_is_refused_by_its_side(side):
    infos = [
        info_of(np.array([[700.0, 0, 600, x], [0, 700, 180, 0], [0, 0, 1, 0]])) for x in (0, -70)
    ]
    infos[side] = infos[side]._replace(R=np.zeros((3, 3)))
    with pytest.raises(ReconError, match=f"R of the {('left', 'right')[side]} CameraInfo is not a"):
        rig_of_messages(infos[0], infos[1], Path("a.bag"), rectified=False)


def info_of(P: np.ndarray) -> BagCameraInfo:
    return BagCameraInfo(1242, 375, "plumb_bob", np.zeros(5), P[:, :3], np.eye(3), P)


@pytest.mark.parametrize("rectified", [True, False])
@pytest.mark.parametrize("centre", [-0.06, 0.0, 0.27, 3.0])
def test_the_baseline_is_between_the_cameras_wherever_both_measure_from(rectified, centre):
    """KITTI's colour pair measures from the grey left camera, others from the middle."""
    K = np.array([[721.5, 0, 609.6], [0, 721.5, 172.9], [0, 0, 1]])
    infos = [info_of(K @ np.array([[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0.0027]]))
             for x in (centre, centre - 0.5327)]  # fmt: skip
    rig = rig_of_messages(*infos, Path("drive.bag"), rectified)
    assert rig.baseline_m == pytest.approx(0.5327, rel=1e-9)
    with pytest.raises(ReconError, match="to the left of the left camera"):
        rig_of_messages(*infos[::-1], Path("drive.bag"), rectified)


VIEW = RectifiedCamera(72.0, 61.0, 17.3, 61.0, 0.54, 124, 37)
RAW = {"K": [98.4, 0, 69.0, 0, 98.4, 23.3, 0, 0, 1], "D": [-0.37, 0.2, 0.002, 0.001, -0.07]}
RAW_TOPICS = ("/kitti/left/image_raw", "/kitti/right/image_raw")


def recorded(
    folder: Path, size: tuple[int, int], image: np.ndarray, **infos: object
) -> StereoSource:
    with recorder(folder, Recording("ros1")) as made:
        made.camera_infos(START_NS, VIEW, RAW_TOPICS, size, **infos)
        for topic in RAW_TOPICS:
            made.write(topic, START_NS, made.image(START_NS, image))
    return open_source(folder / "drive.bag")


@pytest.mark.parametrize("size", [(124, 37), (139, 51), (0, 0)])
def test_rectified_images_beside_the_lens_of_the_camera_are_read_by_their_projection(
    tmp_path, size
):
    """As kitti2bag writes: images of 1242x375, and K and D of those of 1392x512."""
    source = recorded(tmp_path, size, np.zeros((37, 124), np.uint8), **RAW)
    assert source.calibration == VIEW
    assert len(list(source)) == 1
    (said,) = source.warnings()
    assert "K and D of the CameraInfo are not of these images of 124x37" in said
    assert said in source.description


@pytest.mark.parametrize("size", [(139, 51), (0, 0)])
def test_images_of_the_lens_are_raw_though_their_projection_fits_as_well(tmp_path, size):
    source = recorded(tmp_path, size, np.zeros((51, 139), np.uint8), **RAW)
    assert isinstance(source.calibration, StereoCalibration)
    assert (len(list(source)), source.warnings()) == (1, [])


def test_images_of_half_the_size_of_their_calibration_are_still_refused(tmp_path):
    source = recorded(tmp_path, (139, 51), np.zeros((25, 69), np.uint8), **RAW)
    with pytest.raises(ReconError, match="another size than the calibration"):
        list(source)


# The camera sits 1 m ahead and 0.4 m up, looks ahead and is tilted; by way of a bracket.
T_BASE_BRACKET = make_transform(np.eye(3), np.array([1.0, 0.0, 0.0]))
T_BRACKET_CAM = make_transform(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) @ exp_so3([0.2, 0.0, 0.0]),
    np.array([0.0, 0.0, 0.4]),
)


def base(index: int) -> np.ndarray:
    step = make_transform(exp_so3(np.array([0.0, 0.0, 0.05])), np.array([0.3, 0.0, 0.0]))
    return np.linalg.matrix_power(step, index)


def write_moving(folder: Path, kind: str, *, static: bool = True) -> Path:
    """Three pairs, with odometry, transforms and a topic of another type."""
    how = Recording(kind)
    with recorder(folder, how) as bag:
        if static:
            parts = [
                # The second one the other way round, as some publishers have it.
                bag.transform(START_NS, "base_link", "bracket", T_BASE_BRACKET),
                bag.transform(START_NS, "cam", "bracket", invert(T_BRACKET_CAM)),
            ]
            bag.write("/tf_static", START_NS, bag.transforms(*parts))
        for index in range(3):
            stamp = START_NS + index * 10**8
            moved = bag.transform(stamp, "odom", "base_link", base(index))
            wheel = bag.transform(stamp, "base_link", "wheel", base(index))
            bag.write("/tf", stamp, bag.transforms(moved, wheel))
            bag.write("/odom", stamp, bag.odometry(stamp, base(index)))
            bag.camera_infos(stamp, CAMERA)
            for topic in TOPICS:
                bag.write(topic, stamp, bag.image(stamp, GREY))
    return how.path(folder)


@pytest.mark.parametrize("kind", KINDS)
def test_odometry_of_a_bag_becomes_the_path_of_its_camera(tmp_path, kind):
    source = open_source(write_moving(tmp_path, kind))
    assert "other topics: /odom, /tf, /tf_static (for --prior: /odom, /tf)" in source.description
    T_base_camera = T_BASE_BRACKET @ T_BRACKET_CAM
    expected = np.stack([base(index) @ T_base_camera for index in range(3)])
    for topic in ("/odom", "/tf"):
        found = source.read_prior(topic)
        # Quaternions of unit length to 16 digits.
        np.testing.assert_allclose(found.path.T_world_camera, expected, atol=1e-12)
        times = drives.EPOCH_S + 0.1 * np.arange(3)
        np.testing.assert_allclose(found.path.timestamps_s, times, atol=1e-6)
        moved = "3 poses of base_link in odom, moved to cam by the static transforms"
        assert found.origin == f"{topic}, {moved}"


def test_a_prior_may_be_of_the_body_or_a_file_and_nothing_else(tmp_path):
    source = open_source(write_moving(tmp_path, "ros1", static=False))
    found = source.read_prior("/odom")
    np.testing.assert_allclose(found.path.T_world_camera[2], base(2), atol=1e-12)
    assert "no static transform to cam" in found.origin
    for name in (TOPICS[0], "/wheels"):
        with pytest.raises(ReconError, match=r"no such topic of poses.*expected /odom \(3\), /tf"):
            source.read_prior(name)
    path = tmp_path / "wheels.txt"
    path.write_text("0 0 0 0 0 0 0 1\n1 0 0 2 0 0 0 1\n")
    found = source.read_prior(str(path))
    assert (found.path.path_length_m, found.origin) == (2, str(path))


@pytest.mark.parametrize(("write", "victim", "ratio", "message"), [
    (drives.write_lossy_videos, "left.mp4", 0.5, "not a readable video"),
    (drives.write_two_videos, "right.avi", 0.5, "video is truncated"),
    (drives.write_side_by_side, "both.mkv", 0.0, "not a readable video"),
    (drives.write_two_videos, "left.avi", 0.01, "video"),
])  # fmt: skip
def test_a_video_that_cannot_be_read_is_one_line(noise, tmp_path, write, victim, ratio, message):
    path = write(noise, CAMERA, tmp_path)
    halve(tmp_path / victim, ratio)
    fails(path, message)


@pytest.mark.parametrize("shorter", ["left", "right"])
def test_a_video_may_end_a_little_earlier(noise, tmp_path, shorter):
    pairs = [pair for pair in noise for _ in range(2)]
    drives.write_two_videos(pairs, CAMERA, tmp_path)
    views = [getattr(pair, shorter) for pair in pairs]
    drives.write_video(tmp_path / f"{shorter}.avi", views[:-1])
    source = open_source(tmp_path)
    assert source.left_out == 1
    assert source.description.startswith("two videos, 10 Hz, paired frame by frame")
    assert f"1 {'right' if shorter == 'left' else 'left'}" in source.description
    assert len(list(source)) == len(source) == 23
    drives.write_video(tmp_path / f"{shorter}.avi", views[:-2])
    fails(tmp_path, r"different numbers of frames \(got left 2[24], right 2[24]\)")


def test_two_videos_must_advance_alike(noise, tmp_path):
    source = open_source(drives.write_two_videos(noise, CAMERA, tmp_path))
    for drift_s in (0.049, -0.049):
        source._check_pace(3, drift_s)
    for drift_s in (0.051, -0.051):
        with pytest.raises(SourceError, match=rf"right\.avi, frame 3: .*{drift_s}"):
            source._check_pace(3, drift_s)


def test_a_video_that_cannot_be_halved_is_reported():
    video = VideoFile(Path("both.avi"), frames=3, width_px=127, height_px=32, rate_hz=10.0)
    with pytest.raises(ReconError, match=r"both.avi: .*cannot be halved \(got 127x32\)"):
        view_size(video, SourceSettings())
    assert view_size(video, SourceSettings(side_by_side="top-bottom")) == (127, 16)


@pytest.mark.parametrize(
    ("layout", "stack", "hint"),
    [("right-left", np.vstack, "fits it cut so: --set source.side_by_side=top-bottom"),
     ("top-bottom", np.hstack, "fits it cut so: --set source.side_by_side=left-right"),
     ("left-right", lambda views: views[0], "it shows one camera: name .* --right"),
     ("left-right", lambda views: np.tile(views[0], (3, 3)), "use images as they were calibrated")],
)  # fmt: skip
def test_views_that_are_cut_wrongly_are_refused_with_the_cut_that_fits(
    noise, tmp_path, layout, stack, hint
):
    drives.write_calib(tmp_path, CAMERA)
    images = [stack((pair.left, pair.right)) for pair in noise]
    path = drives.write_video(tmp_path / "both.avi", images)
    with pytest.raises(ReconError, match=f"another size .*{hint}"):
        open_source(path, settings=SourceSettings(side_by_side=layout))


@pytest.mark.parametrize(
    ("layout", "flip", "stack"),
    [("right-left", True, np.hstack), ("top-bottom", False, np.vstack),
     ("bottom-top", True, np.vstack)],
)  # fmt: skip
def test_views_may_stand_in_any_order_in_one_video(noise, tmp_path, layout, flip, stack):
    images = [[p.left, p.right][:: -1 if flip else 1] for p in noise]
    drives.write_calib(tmp_path, CAMERA)
    path = drives.write_video(tmp_path / "both.avi", [stack(both) for both in images])
    source = open_source(path, settings=SourceSettings(side_by_side=layout))  # type: ignore[arg-type]
    assert source.description.startswith(f"{layout} in one video, 10 Hz")
    if layout == "top-bottom":  # which the calibration says, too
        source = open_source(path)
        assert source.description.startswith("top-bottom in one video, 10 Hz")
        assert "one above the other: the upper one is the left" in source.warnings()[0]
    read = list(source)
    np.testing.assert_array_equal(read[3].left[:, :, 0], noise[3].left)
    np.testing.assert_array_equal(read[3].right[:, :, 0], noise[3].right)


PLACES = np.column_stack([49.0 + 1e-5 * np.arange(8), np.full(8, 8.4), 115 + 0.1 * np.arange(8)])


def write_fixes(
    folder, kind="mcap", topics=("/gps/fix",), sigma_m=(0.02, 0.01, 0.03), places=PLACES, **how
):
    with recorder(folder, Recording(kind)) as bag:
        bag.write("/imu", START_NS, bag.imu(START_NS, np.zeros(3), np.zeros(3), "imu"))
        for number, place in enumerate(places):
            time_ns = START_NS + 100_000_000 * number
            for topic in topics:
                bag.write(topic, time_ns + 5_000_000, bag.fix(time_ns, place, sigma_m, **how))
    return Recording(kind).path(folder)


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
def test_positions_have_the_times_of_their_headers_and_the_spread_of_their_covariance(
    tmp_path, kind
):
    found = read_measured(write_fixes(tmp_path, kind))
    np.testing.assert_allclose(found.times_s, START_NS / 1e9 + 0.1 * np.arange(8), atol=1e-6)
    np.testing.assert_allclose(found.places, PLACES, rtol=1e-12)
    np.testing.assert_allclose(found.sigma_m, np.tile([0.02, 0.01, 0.03], (8, 1)))
    assert (found.degrees, found.heights) == (True, "the ellipsoid")


def test_what_is_not_known_is_not_invented(tmp_path):
    path = write_fixes(tmp_path, sigma_m=None)
    assert np.isnan(read_measured(path).sigma_m).all()
    endless = write_fixes(tmp_path / "endless", sigma_m=np.full(3, np.inf))
    assert np.isnan(read_measured(endless).sigma_m).all()
    with pytest.raises(ReconError, match="no position"):
        read_measured(write_fixes(tmp_path / "none", status=-1))


@pytest.mark.parametrize("height_m", [np.nan, np.inf, 1e300, -1e20])
def test_a_message_without_a_height_on_earth_is_left_out(tmp_path, height_m):
    places = PLACES.copy()
    places[3, 2] = height_m
    found = read_measured(write_fixes(tmp_path, places=places))
    np.testing.assert_allclose(found.places, np.delete(PLACES, 3, axis=0), rtol=1e-12)


def test_of_several_receivers_one_is_named(tmp_path):
    path = write_fixes(tmp_path, topics=("/front/fix", "/rear/fix"))
    with pytest.raises(ReconError, match=r"several receivers .*/front/fix \(8\).*:/front/fix"):
        read_measured(path)
    assert len(read_measured(Path(f"{path}:/rear/fix")).times_s) == 8
    with pytest.raises(ReconError, match=r"no positions of a receiver .*/front/fix"):
        read_measured(Path(f"{path}:/imu"))


def test_a_recording_without_a_receiver_names_its_topics(tmp_path):
    with pytest.raises(ReconError, match=r"no positions of a receiver .*no NavSatFix among /imu"):
        read_measured(write_fixes(tmp_path, topics=()))
    with pytest.raises(ReconError, match="does not exist"):
        read_measured(tmp_path / "missing.bag")
