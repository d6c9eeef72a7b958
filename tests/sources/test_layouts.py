"""Layouts and names of image files: how they are recognised, paired, timed, and refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import CalibrationError, FormatError, ReconError, SourceError
from recon.core.geometry.se3 import invert, make_transform
from recon.core.values import CameraIntrinsics, StereoCalibration
from recon.io.cameras.calibration import write_recon_calibration
from recon.io.cameras.named import read_euroc_camera
from recon.io.cameras.ros import write_kalibr
from recon.io.images.image import write_image
from recon.sources.images import find_partners, pair_images
from recon.sources.kitti import open_kitti
from recon.sources.one_pair import read_pair, read_pair_input
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from recon.sources.times import pair_stamps, stamp_of_name
from tests.hostile.refusals import assert_refused, run
from tests.sources import drives
from tests.sources.drives import CAMERA, write_calib

Spoil = Callable[[Path], object]

MIDDLEBURY = (
    "cam0=[700 0 16; 0 700 8; 0 0 1]\ncam1=[700 0 18; 0 700 8; 0 0 1]\n"
    "doffs=2\nbaseline=500\nwidth=32\nheight=16\nndisp=20\n"
)


def image(*shape: int) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, shape or (16, 32), dtype=np.uint8)


def make_middlebury(folder: Path) -> Path:
    for name in ("im0.png", "im1.png"):
        write_image(folder / name, image(16, 32, 3))
    (folder / "calib.txt").write_text(MIDDLEBURY)
    return folder


def make_video(folder: Path) -> Path:
    drives.write_calib(folder, CAMERA)
    return drives.write_video(folder / "left.avi", [image(16, 64)] * 3)


CALIB = {
    0: "700 0 16 0 0 700 8 0 0 0 1 0",
    1: "700 0 16 -350 0 700 8 0 0 0 1 0",
    2: "700 0 16 70 0 700 8 0 0 0 1 0",  # 0.1 m to the left of camera 0
    3: "700 0 16 -280 0 700 8 0 0 0 1 0",
}
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0\n"
# A quarter turn to the right about the y axis, and a metre ahead.
TURNED = "0 0 1 0 0 1 0 0 -1 0 0 1\n"


def make_kitti(folder: Path, frames: int = 3, cameras: tuple = (0, 1), poses: str = "") -> Path:
    rng = np.random.default_rng(0)
    for camera in cameras:
        for frame in range(frames):
            shape = (16, 32) if camera < 2 else (16, 32, 3)
            pixels = rng.integers(0, 256, shape, dtype=np.uint8)
            write_image(folder / f"image_{camera}" / f"{frame:06d}.png", pixels)
    (folder / "calib.txt").write_text("".join(f"P{c}: {CALIB[c]}\n" for c in cameras))
    (folder / "times.txt").write_text("".join(f"{0.1 * frame:.6f}\n" for frame in range(frames)))
    if poses:
        (folder / "poses.txt").write_text(poses)
    return folder


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("make", [make_kitti, make_middlebury, make_video])
def test_a_name_where_nothing_is_named_is_refused(tmp_path, make, side):
    ended = run("map", make(tmp_path / "in"), f"--{side}", "X", "--out", tmp_path / "out")
    other = make is make_video and side == "right"
    assert_refused(ended, "X: file does not exist" if other else f"got --{side} X); leave it out")


@pytest.mark.parametrize(("name", "message"), [
    ("none", "folder does not exist"),
    ("notes.txt", "file is not a source of stereo pairs.*KITTI drive.*Middlebury scene"),
    ("empty", "folder is empty"),
    ("other", "folder is not a source of stereo pairs.*KITTI drive.*Middlebury scene"),
])  # fmt: skip
def test_what_is_no_source_is_one_clear_line(tmp_path, name, message):
    for folder in ("empty", "other"):
        (tmp_path / folder).mkdir()
    for path in (tmp_path / "notes.txt", tmp_path / "other" / "notes.txt"):
        path.write_text("x")
    with pytest.raises(SourceError, match=rf"{name}: {message}"):
        open_source(tmp_path / name)
    with pytest.raises(SourceError, match=r"got rosbag, expected bag, euroc, kitti-raw, "):
        open_source(tmp_path, "rosbag")


def test_a_middlebury_scene_has_its_geometry_one_frame_and_no_path(tmp_path):
    folder = make_middlebury(tmp_path / "2014")
    source = open_source(folder, settings=SourceSettings(end=1))
    assert (source.calibration.baseline_m, source.calibration.doffs_px) == (0.5, 2)
    assert (source.truth, source.calibration.ndisp) == (None, 20)
    assert (len(list(source)), len(list(source.frames(1)))) == (1, 0)
    with pytest.raises(SourceError, match="no frame is chosen"):
        open_source(folder, settings=SourceSettings(start=1))
    for name in ("im2.png", "im6.png"):
        write_image(tmp_path / "2003" / name, image())
    with pytest.raises(CalibrationError, match=r"no calibration is published.*expected calib\.txt"):
        open_source(tmp_path / "2003")


def make_files(folder: Path, *right: int) -> list[Path]:
    write_image(folder / "left.png", image())
    write_image(folder / "right.png", image(*right))
    (folder / "calib.txt").write_text(f"P0: {CALIB[0]}\nP1: {CALIB[1]}\n")
    return [folder / "left.png", folder / "right.png", folder / "calib.txt"]


def test_one_pair_of_files_is_read_with_its_calibration(tmp_path):
    files = make_files(tmp_path)
    given = read_pair_input(*files)
    assert (given.pair.name, [*given.files]) == ("left.png", files)
    assert given.calibration.baseline_m == 0.5
    left, right, _ = make_files(tmp_path, 16, 32, 3)
    pair = read_pair(left, right)  # a grey and a coloured image make a coloured pair
    assert pair.left.shape == pair.right.shape == (16, 32, 3)
    np.testing.assert_array_equal(pair.left[:, :, 1], image())
    with pytest.raises(SourceError, match=r"right\.png: .*got left 32x16, right 31x16"):
        read_pair_input(*make_files(tmp_path, 16, 31))


def test_a_kitti_drive_gives_its_pairs_in_order_with_times_names_and_files(tmp_path):
    folder = make_kitti(tmp_path / "drive", poses=IDENTITY * 3)
    for name in ("notes.md", "image_0/Thumbs.db", "image_0/._000000.png"):
        (folder / name).write_text("not read")
    source = open_kitti(folder)
    pairs = list(source)
    assert (source.name, len(source), len(pairs)) == ("drive", 3, 3)
    assert [pair.index for pair in pairs] == [0, 1, 2]
    assert [pair.timestamp_s for pair in pairs] == [0, 0.1, 0.2]
    assert pairs[1].name == "000001.png"
    assert not np.array_equal(pairs[0].left, pairs[0].right)
    assert (source.calibration.width_px, source.calibration.height_px) == (32, 16)
    assert source.calibration.baseline_m == 0.5
    assert len(list(source)) == 3  # it can be read again
    names = [path.relative_to(folder).as_posix() for path in source.files]
    assert names[:3] == ["calib.txt", "times.txt", "poses.txt"]
    assert names[3:5] == ["image_0/000000.png", "image_1/000000.png"]
    assert len(names) == len(set(names)) == 9
    for name in ("times.txt", "poses.txt"):
        (folder / name).unlink()
    source = open_kitti(folder, SourceSettings(rate_hz=4.0))  # which stands in for times
    assert [pair.timestamp_s for pair in source] == [0.0, 0.25, 0.5]
    assert (source.truth, len(source.files)) == (None, 7)


@pytest.mark.parametrize(("cameras", "dimensions"), [((0, 1, 2, 3), 2), ((0, 2, 3), 3)])
def test_a_whole_pair_is_taken(tmp_path, cameras, dimensions):
    folder = make_kitti(tmp_path, cameras=cameras)
    assert next(iter(open_kitti(folder))).left.ndim == dimensions


@pytest.mark.parametrize(("cameras", "poses", "expected"), [
    ((0, 1), TURNED + TURNED, [[0, 0, 0], [0, 0, 0]]),
    # Camera 2 sits at x = -0.1 m. Turned to the right about camera 0 it comes to z = 1 + 0.1 m.
    ((2, 3), IDENTITY + TURNED, [[0, 0, 0], [0.1, 0, 1.1]]),
])  # fmt: skip
@pytest.mark.parametrize("place", ["poses.txt", "../../poses/06.txt"])  # KITTI's own download
def test_truth_is_that_of_the_left_camera_and_starts_at_the_identity(
    tmp_path, cameras, poses, expected, place
):
    folder = make_kitti(tmp_path / "sequences" / "06", 2, cameras)
    (tmp_path / "poses").mkdir()
    # Lines beyond the last image are ignored.
    (folder / place).write_text(poses + IDENTITY)
    with (folder / "times.txt").open("a") as times:
        times.write("0.2\n")
    truth = open_kitti(folder).truth.trajectory
    np.testing.assert_allclose(truth.T_world_camera[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(truth.positions_m, expected, atol=1e-12)
    np.testing.assert_array_equal(truth.timestamps_s, [0, 0.1])


def remove(name: str) -> Spoil:
    return lambda folder: (folder / name).unlink()


def write(name: str, text: str) -> Spoil:
    return lambda folder: (folder / name).write_text(text)


def empty(*names: str) -> Spoil:
    return lambda folder: [path.unlink() for name in names for path in (folder / name).iterdir()]


def drop_folder(name: str) -> Spoil:
    return lambda folder: (empty(name)(folder), (folder / name).rmdir())


def shrink(name: str) -> Spoil:
    return lambda folder: write_image(folder / name, np.zeros((16, 31), dtype=np.uint8))


def cut(name: str) -> Spoil:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:100])


@pytest.mark.parametrize(("spoil", "message"), [
    (empty("image_1"), "image_1: folder contains no images"),
    (empty("image_0", "image_1"), "image_0: folder contains no images"),
    (drop_folder("image_1"), "folder of the other camera is missing.*image_1"),
    (remove("calib.txt"), r"calib\.txt: calibration is missing .*--calib"),
    (write("calib.txt", f"P0: {CALIB[0]}\n"), r"calib\.txt: .*has no P1"),
    (write("calib.txt", f"P0: {CALIB[0]}\nP1: {CALIB[0]}\n"), r"calib\.txt: baseline is zero"),
    (write("calib.txt", f"P0: {CALIB[1]}\nP1: {CALIB[0]}\n"), r"camera is to the left.*swap left"),
    (remove("times.txt"), r"times\.txt: times are missing; .*source\.rate_hz="),
    (write("times.txt", "0\n0.1\n"), r"times\.txt: fewer times than images \(got 2"),
    (write("times.txt", "0\n0.2\n0.1\n"), r"times\.txt:3: timestamps are out of order"),
    (write("times.txt", "0\n0.1\n0.1\n"), r"times\.txt:3: two images have the same timestamp"),
    (write("times.txt", "0\n100\n200\n"), r"times\.txt: times are not those.*got 100 s"),
    (write("times.txt", "5\n5\n5\n"), r"times\.txt: times are not those.*got 0 s"),
    (write("times.txt", "0\nnan\n1\n"), r"times\.txt:2: number is not finite"),
    (write("poses.txt", IDENTITY), r"poses\.txt: fewer poses than images \(got 1"),
    (write("poses.txt", IDENTITY * 2 + "nan " * 12), r"poses\.txt:3: number is not finite"),
    (write("poses.txt", "2" + IDENTITY[1:]), r"poses\.txt:1: .*rigid transform"),
    (write("image_0/000000.png", "text"), r"000000\.png: not an image"),
])  # fmt: skip
def test_a_spoiled_drive_is_refused_before_the_run_by_its_file(tmp_path, spoil, message):
    folder = make_kitti(tmp_path / "drive", poses=IDENTITY * 3)
    spoil(folder)
    with pytest.raises(ReconError, match=message) as caught:
        open_source(folder)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    with pytest.raises(SourceError, match="none: folder does not exist"):
        open_kitti(tmp_path / "none")
    with pytest.raises(SourceError, match="folder has no images in KITTI's layout"):
        open_kitti(tmp_path)


@pytest.mark.parametrize(("spoil", "message"), [
    (shrink("image_0/000002.png"), "000002.png: .*another size.*got 31x16, expected 32x16"),
    (shrink("image_1/000002.png"), "000002.png: .*another size.*got 31x16, expected 32x16"),
    (cut("image_1/000002.png"), r"000002\.png: PNG image is truncated"),
])  # fmt: skip
def test_a_spoiled_image_is_named_in_its_turn(tmp_path, spoil, message):
    folder = make_kitti(tmp_path)
    spoil(folder)
    pairs = iter(open_kitti(folder))
    assert [next(pairs).index for _ in range(2)] == [0, 1]
    with pytest.raises(ReconError, match=message):
        next(pairs)


def test_an_unrectified_kitti_drive_gets_its_raw_lenses(noise, tmp_path):
    drive = drives.write_kitti_raw(noise, CAMERA, tmp_path)
    calib = tmp_path / "calib_cam_to_cam.txt"
    text = calib.read_text().replace("S_rect_00: 64 32", "S_rect_00: 60 30")
    calib.write_text(text.replace("S_00: 1392 512", "S_00: 64 32"))
    source = open_source(drive)
    rig = source.calibration
    assert "not rectified" in source.description
    assert rig.left.distortion[0] == -0.3
    # xyz_1 = xyz_0 + T_01: the right camera is half a metre to the right.
    np.testing.assert_allclose(rig.T_right_left[:3, 3], [-0.5, 0, 0], atol=1e-12)
    calib.write_text(text)
    with pytest.raises(ReconError, match=r"got 64x32, expected 60x30 rectified, or 1392x512 raw"):
        open_source(drive)


def test_a_euroc_drive_takes_sensors_or_the_camchain(noise, tmp_path):
    drives.write_euroc(noise, CAMERA, tmp_path)
    plain = {path: path.read_text() for path in tmp_path.rglob("sensor.yaml")}
    for tag in ("", "!!opencv-matrix"):
        for path, text in plain.items():
            path.write_text("%YAML:1.0\n---\n" + text.replace("T_BS:", f"T_BS: {tag}"))
        assert open_source(tmp_path).calibration == CAMERA
    for path, text in plain.items():
        path.write_text(text.replace("- 32\n", "- 16\n"))
    with pytest.raises(ReconError, match=r"images have another size.*got 64x32, expected 64x16"):
        open_source(tmp_path)
    for path in plain:
        path.unlink()
    left = CameraIntrinsics(CAMERA.matrix, np.zeros(4), 64, 32)
    T = make_transform(np.eye(3), np.array([-CAMERA.baseline_m, 0, 0]))
    (tmp_path / "dso").mkdir()  # as TUM VI is published
    write_kalibr(tmp_path / "dso" / "camchain.yaml", StereoCalibration(left, left, T))
    assert open_source(tmp_path).calibration == CAMERA
    (tmp_path / "dso" / "camchain.yaml").unlink()
    with pytest.raises(ReconError, match=r"calibration is missing.*--calib FILE"):
        open_source(tmp_path)


def test_the_true_path_of_euroc_is_that_of_the_left_camera(noise, tmp_path):
    drives.write_euroc(noise, CAMERA, tmp_path)
    # The body goes ahead along its x, 2 m/s, measured between the frames; it does not turn.
    rows = [
        f"{drives.EPOCH_S * 10**9 + k * 70_000_000 - 10_000_000},{0.14 * k},5,7,0.6,0,0,0.8"
        for k in range(20)
    ]
    truth = tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    truth.parent.mkdir()
    truth.write_text("#timestamp,x,y,z,qw,qx,qy,qz\n" + "\n".join(rows) + "\n")
    found = open_source(tmp_path).truth
    turn = 2 * np.arctan2(0.8, 0.6)  # the body is turned about its z axis, 106 degrees
    ahead = 0.2 * np.arange(12)
    # In axes of the first camera (x right, z ahead), which looks along the body's x.
    expected = np.stack([ahead * np.sin(turn), 0 * ahead, ahead * np.cos(turn)], axis=1)
    # Stamps of today have 0.2 µs in a double: 0.4 µm at 2 m/s.
    np.testing.assert_allclose(found.trajectory.positions_m, expected, atol=2e-6)
    # TUM VI: of its inertial unit, which a camchain places.
    left = CameraIntrinsics(CAMERA.matrix, np.zeros(4), 64, 32)
    T_body_left = read_euroc_camera(tmp_path / "mav0" / "cam0" / "sensor.yaml")[1]
    T = make_transform(np.eye(3), np.array([-CAMERA.baseline_m, 0, 0]))
    for path in tmp_path.rglob("sensor.yaml"):
        path.unlink()
    chain = tmp_path / "camchain.yaml"
    write_kalibr(chain, StereoCalibration(left, left, T))
    truth.parent.rename(truth.parent.with_name("mocap0"))
    assert open_source(tmp_path).truth is None
    cameras = yaml.safe_load(chain.read_text())
    cameras["cam0"]["T_cam_imu"] = invert(T_body_left).tolist()
    chain.write_text(yaml.safe_dump(cameras))
    found = open_source(tmp_path).truth
    np.testing.assert_allclose(found.trajectory.positions_m, expected, atol=2e-6)
    truth = tmp_path / "mav0" / "mocap0" / "data.csv"
    truth.write_text("\n".join(rows[3:]) + "\n")
    source = open_source(tmp_path)
    assert source.truth is None
    assert "ground truth for only 10 of 12 frames: not used" in source.description


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(
    ("kind", "write", "end"),
    [("tum", drives.write_tum, ".txt"), ("video", drives.write_two_videos, ".avi")],
)
def test_lists_and_videos_can_be_named_and_one_name_alone_is_not_enough(
    noise, tmp_path, kind, write, end, side
):
    folder, other = write(noise, CAMERA, tmp_path), {"left": "port", "right": "starboard"}
    alone = SourceSettings(**{side: f"{side}{end}"})  # also of those that are found without a name
    with pytest.raises(SourceError, match=rf"only one .*got --{side} {side}{end}.* --left and"):
        open_source(folder, kind, alone)
    for view, name in other.items():
        (folder / f"{view}{end}").rename(folder / f"{name}{end}")
    named = {view: f"{name}{end}" for view, name in other.items()}
    assert len(list(open_source(folder, kind, SourceSettings(**named)))) == 12
    with pytest.raises(SourceError, match="name them with --left and --right"):
        open_source(folder, kind, SourceSettings(**{side: named[side]}))


def test_folders_of_any_name_and_place_can_be_named(noise, tmp_path):
    sides = ("port", "starboard")
    drives.write_images(noise, None, tmp_path, lambda n, pair: f"{sides[n]}/{pair.index}")
    calib = str(drives.write_calib(tmp_path / "papers", CAMERA))
    inside = SourceSettings(left="port", right="starboard", calibration=calib)
    beside = SourceSettings(right=str(tmp_path / "starboard"), calibration=calib)
    for path, settings in ((tmp_path, inside), (tmp_path / "port", beside)):
        pairs = list(open_source(path, "folders", settings))
        np.testing.assert_array_equal(pairs[11].right, noise[11].right)


@pytest.mark.parametrize("left", ["front_left", "rear_left", None])
def test_one_of_several_pairs_can_be_named(noise, tmp_path, left):
    for number, side in enumerate(("front_left", "front_right", "rear_left", "rear_right")):
        for k in range(3):
            write_image(tmp_path / side / "data" / f"{k}.png", noise[4 * k + number].left)
    drives.write_calib(tmp_path, CAMERA)
    pair = list(open_source(tmp_path, settings=SourceSettings(left=left)))[2]
    first = 10 if left == "rear_left" else 8
    np.testing.assert_array_equal(pair.left, noise[first].left)
    np.testing.assert_array_equal(pair.right, noise[first + 1].left)


def test_folders_without_pairs_or_calibration_are_refused(noise, tmp_path):
    drives.write_stamped(noise[:1], CAMERA, tmp_path / "stamped")
    with pytest.raises(SourceError, match=r"no left and right .* same time.*0\.002 s apart"):
        open_source(tmp_path / "stamped", settings=SourceSettings(tolerance_s=0.001))
    folder = drives.write_folders(noise, CAMERA, tmp_path / "named")
    (folder / "calib.txt").unlink()
    with pytest.raises(SourceError, match=r"calibration is missing.*--calib FILE"):
        open_source(folder)
    # What `recon map` writes is found, also beside the file of another program.
    write_recon_calibration(folder / "rig.yaml", CAMERA)
    (folder / "stereo_params.xml").write_text("<boofcv.struct.calib.StereoParameters/>")
    assert open_source(folder).calibration == CAMERA
    for number, path in enumerate(sorted((folder / "right").iterdir())[1:]):
        path.rename(path.with_stem(f"photo{100 + 7 * number}"))
    (folder / "right" / "right0.png").unlink()
    with pytest.raises(SourceError, match=r"numbers of left .* differ \(got 12 left and 11 right"):
        open_source(folder)


@pytest.mark.parametrize("layout", ["kitti", "kitti_raw", "tum", "folders"])
@pytest.mark.parametrize("repaired", [True, False])
def test_a_rig_beside_the_calibration_of_a_drive_is_not_used_and_that_is_said(
    noise, tmp_path, layout, repaired
):
    folder = getattr(drives, f"write_{layout}")(noise, CAMERA, tmp_path)
    before = open_source(folder)
    assert before.warnings() == []
    rig = folder / "rig.yaml"
    if repaired:
        write_recon_calibration(rig, replace(CAMERA, baseline_m=0.25))
    else:
        rig.write_text("format: recon\nbaseline_m: [")
    source = open_source(folder)
    assert source.calibration == before.calibration
    (line,) = source.warnings()
    assert line.startswith(f"{rig} is not used")
    assert source.with_calibration(CAMERA).warnings() == [line]
    chosen = SourceSettings(calibration=str(rig))
    if repaired:
        assert open_source(folder, settings=chosen).calibration.baseline_m == 0.25
        assert open_source(folder, settings=chosen).warnings() == []
    else:
        with pytest.raises(FormatError, match=r"rig\.yaml"):
            open_source(folder, settings=chosen)


@pytest.mark.parametrize(
    ("stem", "seconds"),
    [("1305031102.175304", 1305031102.175304), ("1403636579763555584", 1403636579.763555584),
     ("1600000000123", 1600000000.123), ("1600000000123456", 1600000000.123456),
     ("0.25", 0.25), ("000012", None), ("left01", None), ("1_5", None),
     ("²" * 10, None), ("٣" * 19, None)],
)  # fmt: skip
def test_names_that_are_stamps_are_no_counts(stem, seconds):
    assert stamp_of_name(stem) == (seconds if seconds is None else pytest.approx(seconds, abs=1e-6))


STAMPS = st.lists(st.integers(0, 10_000), min_size=1, max_size=30, unique=True)


@given(STAMPS, STAMPS, st.integers(1, 300))
def test_pairs_by_stamp_are_near_and_mutual(left, right, tolerance):
    ours, theirs = (np.array(sorted(s), dtype=np.float64) for s in (left, right))
    apart = np.abs(ours[:, None] - theirs[None])
    near = (apart == apart.min(0)) & (apart == apart.min(1)[:, None]) & (apart <= tolerance)
    alone = near & (near.sum(0) == 1) & (near.sum(1)[:, None] == 1)
    alone &= ((apart == apart.min(0)).sum(0) == 1) & (
        (apart.min(1) == apart.T).sum(0)[:, None] == 1
    )
    try:
        frames = pair_stamps(ours, theirs, float(tolerance), Path("here"))
    except ReconError:
        assert 2 * alone.sum() < min(near.shape)  # two may be as near to a third
        return
    pairs = [(i, j) for i, j in frames if i is not None and j is not None]
    assert all(near[pair] for pair in pairs)
    assert set(zip(*np.nonzero(alone), strict=True)) <= set(pairs)
    for side in (0, 1):  # each image once, in order
        found = [frame[side] for frame in frames if frame[side] is not None]
        assert found == list(range(near.shape[side]))
    times = [ours[i] if i is not None else theirs[j] for i, j in frames]
    assert times == sorted(times)


def test_cameras_half_a_period_apart_are_paired():
    left = np.arange(20.0)
    for apart in (0.5, -0.5):
        frames = pair_stamps(left, left + apart, 0.6, Path("here"))
        assert sum(None not in frame for frame in frames) >= 19


def write_named(folder: Path, names: list[str]) -> Path:
    """Pairs of equal names in two folders, the grey values counting the frames."""
    for number, name in enumerate(names):
        for side in ("left", "right"):
            write_image(folder / side / f"{name}.png", np.full((32, 64), number, np.uint8))
    write_calib(folder, CAMERA)
    return folder


def times(folder: Path, **settings: object) -> list[float]:
    source = open_source(folder, "folders", SourceSettings.model_validate(settings))
    return source.stamps_s.tolist()


@pytest.mark.parametrize("digits", [10, 13, 16, 19])
@pytest.mark.parametrize(("step", "count"), [(1, 4), (5, 4), (1, 1)])
def test_padded_counters_are_no_times(tmp_path, digits, step, count):
    folder = write_named(tmp_path, [f"{100 + step * k:0{digits}d}" for k in range(count)])
    assert times(folder) == [0.0, 0.1, 0.2, 0.3][:count]
    assert "no times: assumed 10 Hz" in open_source(folder).description


@pytest.mark.parametrize("name", ["{:010d}", "16000000{:02d}", "{}.5", "frame{}"])
@pytest.mark.parametrize("place", [".", "left"])
def test_a_times_file_wins_and_may_have_exposures(tmp_path, name, place):
    folder = write_named(tmp_path, [name.format(k) for k in range(4)])
    path = folder / place / "times.txt"
    rows = [f"{k:05d} {7 + 0.25 * k:.6f} 1.5e-3\n" for k in range(4)]
    for text in ("7.0\n7.25\n7.5\n7.75\n", "".join(rows)):
        path.write_text(text)
        assert times(folder) == [7.0, 7.25, 7.5, 7.75]
    assert path in open_source(folder).files
    assert times(folder, rate_hz=5.0) == pytest.approx([0, 0.2, 0.4, 0.6])
    path.write_text("".join([*rows[:2], rows[1], rows[3]]))
    with pytest.raises(SourceError, match=r"times\.txt:3: two images have the same timestamp"):
        times(folder)
    path.write_text("1 2\n3 4\n")
    with pytest.raises(FormatError, match="got 2, expected 1 or 3"):
        times(folder)


def test_partners_are_found_among_names_of_many_rigs():
    for left, right in (
        ("/camera/infra1/image_rect_raw", "/camera/infra2/image_rect_raw"),
        ("/zed/left/image_rect", "/zed/right/image_rect"),
        ("/left_cam/left/image", "/right_cam/right/image"),
        ("/cam0/image_raw", "/cam1/image_raw"),
        ("image_left", "image_right"),
        ("L", "R"),
    ):
        assert find_partners([right, "/other", left]) == [(left, right)]
    assert find_partners(["/front/image", "/rear/image"]) == []


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")


@pytest.mark.parametrize(("left", "right", "expected", "by_order"), [
    # By their numbers, where names differ in the side.
    (["left1.png", "left02.png", "left10.png"],
     ["right10.png", "right01.png", "right2.png", "right.txt"],
     ["left1.png right01.png", "left02.png right2.png", "left10.png right10.png"], False),
    # A number of the camera does not count.
    (["left0_7.png", "left0_8.png"], ["right1_8.png", "right1_7.png"],
     ["left0_7.png right1_7.png", "left0_8.png right1_8.png"], False),
    # By name, whatever the suffix.
    (["left/a.png", "left/b.png"], ["right/b.jpg", "right/a.jpg"],
     ["a.png a.jpg", "b.png b.jpg"], False),
    # By order, where names have nothing in common.
    (["left/100.png", "left/200.png"], ["right/101.png", "right/202.png"],
     ["100.png 101.png", "200.png 202.png"], True),
    (["left_a.png"], ["right_b.png"], ["left_a.png right_b.png"], False),
])  # fmt: skip
def test_images_are_paired_by_name_by_number_or_in_order(tmp_path, left, right, expected, by_order):
    touch(tmp_path, *left, *right)
    sides = ("left", "right") if "/" in left[0] else ("left*", "right*")
    found = pair_images(*(str(tmp_path / side) for side in sides))
    assert [f"{one.name} {other.name}" for one, other in found.pairs] == expected
    assert found.by_order == by_order


def test_images_without_a_partner_are_left_out_and_named(tmp_path):
    touch(tmp_path, *(f"left{n}.png" for n in (1, 2, 3, 5)), "left_notes.png")
    touch(tmp_path, *(f"right{n}.png" for n in (1, 2, 3, 4)), "right_7_again.png")
    found = pair_images(str(tmp_path / "left*"), str(tmp_path / "right*"))
    assert [left.name for left, _ in found.pairs] == ["left1.png", "left2.png", "left3.png"]
    names = {path.name for path in found.lonely}
    assert names == {"left5.png", "left_notes.png", "right4.png", "right_7_again.png"}


@pytest.mark.parametrize(("names", "left", "right", "message"), [
    ("l1.png l2.png l3.png r3.png r4.png r5.png", "l*", "r*",
     r"most have no partner \(got 1 pair of 3 left, 3 right; l1\.png, l2\.png, r4\.png …"),
    ("lx.png ly.png r.png", "l*", "r*", r"do not pair up \(got 2 left, 1 right"),
    ("l1.png r1.png", "*", "*", r"l1\.png: left and right are the same images"),
    ("l1.txt", "l*", "r*", r"no images found.*in quotes"),
])  # fmt: skip
def test_patterns_of_images_that_are_no_pairs_are_refused(tmp_path, names, left, right, message):
    touch(tmp_path, *names.split())
    with pytest.raises(SourceError, match=message):
        pair_images(str(tmp_path / left), str(tmp_path / right))
