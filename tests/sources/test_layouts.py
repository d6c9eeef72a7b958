"""Layouts of image files: how each is recognised, paired and timed, and what is refused of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import CalibrationError, FormatError, ReconError, SourceError
from recon.core.geometry.se3 import make_transform
from recon.core.values import CameraIntrinsics, StereoCalibration
from recon.io.cameras.ros import write_kalibr
from recon.io.images.image import write_image
from recon.io.trajectory import read_kitti_poses
from recon.sources.calibration import camera_of_numbers
from recon.sources.kitti import open_kitti
from recon.sources.one_pair import read_pair, read_pair_input
from recon.sources.registry import open_source, recognise_source
from recon.sources.settings import SourceSettings
from tests.hostile.refusals import assert_refused, run
from tests.sources import drives
from tests.sources.drives import CAMERA, Pairs, Writer

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


def make_kitti(
    folder: Path, frames: int = 3, cameras: tuple[int, ...] = (0, 1), poses: str = ""
) -> Path:
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


@pytest.mark.parametrize(
    ("kind", "make", "pairs"), [("kitti", make_kitti, 3), ("middlebury", make_middlebury, 1)]
)
def test_a_kind_is_recognised_or_named(
    tmp_path: Path, kind: str, make: Callable[[Path], Path], pairs: int
) -> None:
    folder = make(tmp_path / "folder")
    assert recognise_source(folder) == kind
    for source in (open_source(folder), open_source(folder, kind)):
        assert source.name == "folder"
        assert folder / "calib.txt" in source.files
        assert len(source) == len(list(source)) == pairs
        shown = f"{type(source).__name__}(folder, pairs: {pairs}, {source.description})"
        assert repr(source) == shown


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("make", [make_kitti, make_middlebury, make_video])
def test_a_name_of_a_camera_where_nothing_is_named_is_refused(
    tmp_path: Path, make: Callable[[Path], Path], side: str
) -> None:
    ended = run("map", make(tmp_path / "in"), f"--{side}", "X", "--out", tmp_path / "out")
    other = make is make_video and side == "right"
    assert_refused(ended, "X: file does not exist" if other else f"got --{side} X); leave it out")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none", "folder does not exist"),
        ("notes.txt", "file is not a source of stereo pairs.*KITTI drive.*Middlebury scene"),
        ("empty", "folder is empty"),
        ("other", "folder is not a source of stereo pairs.*KITTI drive.*Middlebury scene"),
    ],
)
def test_what_is_no_source_is_one_clear_line(tmp_path: Path, name: str, message: str) -> None:
    for folder in ("empty", "other"):
        (tmp_path / folder).mkdir()
    for path in (tmp_path / "notes.txt", tmp_path / "other" / "notes.txt"):
        path.write_text("x")
    with pytest.raises(SourceError, match=rf"{name}: {message}"):
        open_source(tmp_path / name)
    with pytest.raises(SourceError, match=r"got rosbag, expected bag, euroc, kitti-raw, "):
        open_source(tmp_path, "rosbag")


@pytest.mark.real
@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("driven/kitti_06_51", "kitti"),
        ("middlebury/MiddEval3/trainingQ/Piano", "middlebury"),
        ("middlebury/2005/Art", "middlebury"),
        ("middlebury/2003/Cones", None),
    ],
)
def test_real_folders_are_recognised(recon_data: Path, path: str, kind: str | None) -> None:
    if kind is None:
        with pytest.raises(ReconError, match="no calibration is published"):
            open_source(recon_data / path)
    else:
        assert recognise_source(recon_data / path) == kind
        assert len(open_source(recon_data / path)) > 0


def test_a_middlebury_scene_has_its_geometry_one_frame_and_no_path(tmp_path: Path) -> None:
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


def test_one_pair_of_files_is_read_with_its_calibration(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("name", ["left.png", "right.png", "calib.txt"])
def test_a_missing_file_of_a_pair_is_named(tmp_path: Path, name: str) -> None:
    files = make_files(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(FormatError, match=rf"{name}: file does not exist"):
        read_pair_input(*files)


def test_a_kitti_drive_gives_its_pairs_in_order_with_times_names_and_files(tmp_path: Path) -> None:
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
def test_the_grey_pair_is_taken_unless_only_the_colour_pair_is_whole(
    tmp_path: Path, cameras: tuple[int, ...], dimensions: int
) -> None:
    folder = make_kitti(tmp_path, cameras=cameras)
    assert next(iter(open_kitti(folder))).left.ndim == dimensions


@pytest.mark.parametrize(
    ("cameras", "poses", "expected"),
    [
        ((0, 1), TURNED + TURNED, [[0, 0, 0], [0, 0, 0]]),
        # Camera 2 sits at x = -0.1 m. Turned to the right about camera 0 it comes to z = 1 + 0.1 m.
        ((2, 3), IDENTITY + TURNED, [[0, 0, 0], [0.1, 0, 1.1]]),
    ],
)
@pytest.mark.parametrize("place", ["poses.txt", "../../poses/06.txt"])  # KITTI's own download
def test_truth_is_that_of_the_left_camera_and_starts_at_the_identity(
    tmp_path: Path, cameras: tuple[int, ...], poses: str, expected: list[list[float]], place: str
) -> None:
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


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (empty("image_1"), SourceError, "image_1: folder contains no images"),
        (empty("image_0", "image_1"), SourceError, "image_0: folder contains no images"),
        (drop_folder("image_1"), SourceError, "folder of the other camera is missing.*image_1"),
        (remove("calib.txt"), SourceError, r"calib\.txt: calibration is missing .*--calib"),
        (write("calib.txt", f"P0: {CALIB[0]}\n"), FormatError, r"calib\.txt: .*has no P1"),
        (write("calib.txt", f"P0: {CALIB[0]}\nP1: {CALIB[0]}\n"), CalibrationError,
         r"calib\.txt: baseline is zero"),
        (write("calib.txt", f"P0: {CALIB[1]}\nP1: {CALIB[0]}\n"), CalibrationError,
         r"calib\.txt: baseline is negative.*swapped"),
        (remove("times.txt"), SourceError, r"times\.txt: times are missing; .*source\.rate_hz="),
        (write("times.txt", "0\n0.1\n"), SourceError,
         r"times\.txt: fewer times than images \(got 2 times, expected 3\)"),
        (write("times.txt", "0\n0.2\n0.1\n"), SourceError,
         r"times\.txt:3: timestamps are out of order"),
        (write("times.txt", "0\n0.1\n0.1\n"), SourceError,
         r"times\.txt:3: two images have the same timestamp"),
        (write("times.txt", "0\n100\n200\n"), SourceError,
         r"times\.txt: times are not those of a drive in seconds \(got 100 s from frame"),
        (write("times.txt", "5\n5\n5\n"), SourceError, r"times\.txt: times are not those.*got 0 s"),
        (write("times.txt", "0\nnan\n1\n"), FormatError, r"times\.txt:2: number is not finite"),
        (write("poses.txt", IDENTITY), SourceError,
         r"poses\.txt: fewer poses than images \(got 1 pose, expected 3\)"),
        (write("poses.txt", IDENTITY * 2 + "nan " * 12), FormatError,
         r"poses\.txt:3: number is not finite"),
        (write("poses.txt", "2" + IDENTITY[1:]), FormatError, r"poses\.txt:1: .*rigid transform"),
        (write("image_0/000000.png", "text"), FormatError, r"000000\.png: not an image"),
    ],
)  # fmt: skip
def test_a_spoiled_drive_is_refused_before_the_run_with_one_line_that_names_the_file(
    tmp_path: Path, spoil: Spoil, error: type[ReconError], message: str
) -> None:
    folder = make_kitti(tmp_path / "drive", poses=IDENTITY * 3)
    spoil(folder)
    with pytest.raises(error, match=message) as caught:
        open_source(folder)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    with pytest.raises(SourceError, match="none: folder does not exist"):
        open_kitti(tmp_path / "none")
    with pytest.raises(SourceError, match="folder has no images in KITTI's layout"):
        open_kitti(tmp_path)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (shrink("image_0/000002.png"), "000002.png: .*another size.*got 31x16, expected 32x16"),
        (shrink("image_1/000002.png"), "000002.png: .*another size.*got 31x16, expected 32x16"),
        (cut("image_1/000002.png"), r"000002\.png: PNG image is truncated"),
    ],
)
def test_a_spoiled_image_is_named_when_its_turn_comes(
    tmp_path: Path, spoil: Spoil, message: str
) -> None:
    folder = make_kitti(tmp_path)
    spoil(folder)
    pairs = iter(open_kitti(folder))
    assert [next(pairs).index for _ in range(2)] == [0, 1]
    with pytest.raises(ReconError, match=message):
        next(pairs)


@pytest.mark.real
@pytest.mark.parametrize(
    ("drive", "frames", "size", "baseline_m"),
    [("kitti_raw_0013", 144, (1242, 375), 0.5372), ("kitti_06_51", 51, (1226, 370), 0.5372)],
)
def test_real_drives_open_with_their_truth(
    recon_data: Path, drive: str, frames: int, size: tuple[int, int], baseline_m: float
) -> None:
    folder = recon_data / "driven" / drive
    source = open_kitti(folder)
    camera = source.calibration
    assert (len(source), (camera.width_px, camera.height_px)) == (frames, size)
    assert camera.baseline_m == pytest.approx(baseline_m, abs=1e-4)
    assert source.truth is not None
    truth, published = source.truth.trajectory, read_kitti_poses(folder / "poses.txt")
    assert truth is not None
    assert truth.path_length_m == pytest.approx(published.path_length_m, abs=1e-6)
    assert next(iter(source)).left.shape == size[::-1]
    # The drives are recorded at about 10 Hz.
    assert 0.09 < np.median(np.diff(truth.timestamps_s)) < 0.12


def test_an_unrectified_kitti_drive_gets_its_raw_lenses(noise: Pairs, tmp_path: Path) -> None:
    drive = drives.write_kitti_raw(noise, CAMERA, tmp_path)
    calib = tmp_path / "calib_cam_to_cam.txt"
    text = calib.read_text().replace("S_rect_00: 64 32", "S_rect_00: 60 30")
    calib.write_text(text.replace("S_00: 1392 512", "S_00: 64 32"))
    source = open_source(drive)
    rig = source.calibration
    assert isinstance(rig, StereoCalibration)
    assert "not rectified" in source.description
    assert rig.left.distortion[0] == -0.3
    # xyz_1 = xyz_0 + T_01: the right camera is half a metre to the right.
    np.testing.assert_allclose(rig.T_right_left[:3, 3], [-0.5, 0, 0], atol=1e-12)
    calib.write_text(text)
    with pytest.raises(ReconError, match=r"got 64x32, expected 60x30 rectified, or 1392x512 raw"):
        open_source(drive)


def test_a_euroc_drive_takes_sensors_with_a_header_of_opencv_else_the_camchain_beside_it(
    noise: Pairs, tmp_path: Path
) -> None:
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


def test_the_true_path_of_euroc_is_that_of_the_left_camera(noise: Pairs, tmp_path: Path) -> None:
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
    assert found is not None
    assert found.trajectory is not None
    turn = 2 * np.arctan2(0.8, 0.6)  # the body is turned about its z axis, 106 degrees
    ahead = 0.2 * np.arange(12)
    # In axes of the first camera (x right, z ahead), which looks along the body's x.
    expected = np.stack([ahead * np.sin(turn), 0 * ahead, ahead * np.cos(turn)], axis=1)
    # Stamps of today have 0.2 µs in a double: 0.4 µm at 2 m/s.
    np.testing.assert_allclose(found.trajectory.positions_m, expected, atol=2e-6)
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
    noise: Pairs, tmp_path: Path, kind: str, write: Writer, end: str, side: str
) -> None:
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


def test_folders_of_any_name_and_place_can_be_named(noise: Pairs, tmp_path: Path) -> None:
    sides = ("port", "starboard")
    drives.write_images(noise, None, tmp_path, lambda n, pair: f"{sides[n]}/{pair.index}")
    calib = str(drives.write_calib(tmp_path / "papers", CAMERA))
    inside = SourceSettings(left="port", right="starboard", calibration=calib)
    beside = SourceSettings(right=str(tmp_path / "starboard"), calibration=calib)
    for path, settings in ((tmp_path, inside), (tmp_path / "port", beside)):
        pairs = list(open_source(path, "folders", settings))
        np.testing.assert_array_equal(pairs[11].right, noise[11].right)


@pytest.mark.parametrize("left", ["front_left", "rear_left", None])
def test_of_several_pairs_of_folders_one_can_be_named(
    noise: Pairs, tmp_path: Path, left: str | None
) -> None:
    for number, side in enumerate(("front_left", "front_right", "rear_left", "rear_right")):
        for k in range(3):
            write_image(tmp_path / side / "data" / f"{k}.png", noise[4 * k + number].left)
    drives.write_calib(tmp_path, CAMERA)
    pair = list(open_source(tmp_path, settings=SourceSettings(left=left)))[2]
    first = 10 if left == "rear_left" else 8
    np.testing.assert_array_equal(pair.left, noise[first].left)
    np.testing.assert_array_equal(pair.right, noise[first + 1].left)


def test_folders_that_do_not_pair_up_or_have_no_calibration_are_refused(
    noise: Pairs, tmp_path: Path
) -> None:
    drives.write_stamped(noise[:1], CAMERA, tmp_path / "stamped")
    with pytest.raises(SourceError, match=r"no left and right .* same time.*0\.002 s apart"):
        open_source(tmp_path / "stamped", settings=SourceSettings(tolerance_s=0.001))
    folder = drives.write_folders(noise, CAMERA, tmp_path / "named")
    (folder / "calib.txt").unlink()
    with pytest.raises(SourceError, match=r"calibration is missing.*--calib FILE"):
        open_source(folder)
    for number, path in enumerate(sorted((folder / "right").iterdir())[1:]):
        path.rename(path.with_stem(f"photo{100 + 7 * number}"))
    (folder / "right" / "right0.png").unlink()
    with pytest.raises(SourceError, match=r"numbers of left .* differ \(got 12 left and 11 right"):
        open_source(folder)


@pytest.mark.real
def test_the_chessboard_images_of_opencv_are_pairs(recon_data: Path) -> None:
    source = open_source(recon_data / "calibration" / "opencv_chessboard")
    pairs = list(source)
    assert [pair.name for pair in pairs[7:10]] == ["left08.jpg", "left09.jpg", "left11.jpg"]
    assert isinstance(source.calibration, StereoCalibration)


def test_numbers_alone_make_a_camera_that_looks_through_the_middle() -> None:
    known = SourceSettings(focal_px=60.0, baseline_m=0.5)
    assert camera_of_numbers(known, (64, 32)) == CAMERA
    shifted = camera_of_numbers(known.model_copy(update={"cx_px": 3.0, "cy_px": 7.0}), (64, 32))
    assert (shifted.cx_px, shifted.cx_right_px, shifted.cy_px) == (3.0, 3.0, 7.0)
    for wrong in (SourceSettings(focal_px=60.0), SourceSettings(focal_px=2.0, baseline_m=0.5)):
        with pytest.raises(CalibrationError, match="--focal"):
            camera_of_numbers(wrong, (64, 32))
    camera_of_numbers(known.model_copy(update={"focal_px": 4.5}), (64, 32))  # sees 164 degrees
