from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import CalibrationError, FormatError, ReconError, SourceError
from recon.io.images.image import write_image
from recon.io.trajectory import read_kitti_poses
from recon.sources.kitti import open_kitti
from recon.sources.settings import SourceSettings

CALIB = {
    0: "700 0 16 0 0 700 8 0 0 0 1 0",
    1: "700 0 16 -350 0 700 8 0 0 0 1 0",
    2: "700 0 16 70 0 700 8 0 0 0 1 0",  # 0.1 m to the left of camera 0
    3: "700 0 16 -280 0 700 8 0 0 0 1 0",
}
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0\n"
# A quarter turn to the right about the y axis, and a metre ahead.
TURNED = "0 0 1 0 0 1 0 0 -1 0 0 1\n"


def make_drive(
    folder: Path, frames: int = 3, cameras: tuple[int, ...] = (0, 1), poses: str | None = None
) -> Path:
    rng = np.random.default_rng(0)
    for camera in cameras:
        for frame in range(frames):
            shape = (16, 32) if camera < 2 else (16, 32, 3)
            image = rng.integers(0, 256, shape, dtype=np.uint8)
            write_image(folder / f"image_{camera}" / f"{frame:06d}.png", image)
    (folder / "calib.txt").write_text("".join(f"P{c}: {CALIB[c]}\n" for c in cameras))
    (folder / "times.txt").write_text("".join(f"{0.1 * frame:.6f}\n" for frame in range(frames)))
    if poses is not None:
        (folder / "poses.txt").write_text(poses)
    return folder


def test_a_drive_gives_its_pairs_in_order_with_times_and_names(tmp_path: Path) -> None:
    source = open_kitti(make_drive(tmp_path / "drive"))
    pairs = list(source)
    assert (source.name, len(source), len(pairs)) == ("drive", 3, 3)
    assert [pair.index for pair in pairs] == [0, 1, 2]
    assert [pair.timestamp_s for pair in pairs] == [0, 0.1, 0.2]
    assert pairs[1].name == "000001.png"
    assert not np.array_equal(pairs[0].left, pairs[0].right)
    assert (source.calibration.width_px, source.calibration.height_px) == (32, 16)
    assert source.calibration.baseline_m == 0.5
    assert source.truth is None
    assert len(list(source)) == 3  # it can be read again


def test_all_files_that_are_read_are_listed_and_exist(tmp_path: Path) -> None:
    folder = make_drive(tmp_path, 2, poses=IDENTITY * 2)
    (folder / "notes.md").write_text("not read")
    names = [path.relative_to(folder).as_posix() for path in open_kitti(folder).files]
    assert names[:3] == ["calib.txt", "times.txt", "poses.txt"]
    assert names[3:5] == ["image_0/000000.png", "image_1/000000.png"]
    assert len(names) == len(set(names)) == 7
    assert all((folder / name).is_file() for name in names)


def test_the_grey_pair_is_taken_unless_only_the_colour_pair_is_whole(tmp_path: Path) -> None:
    both = make_drive(tmp_path / "both", cameras=(0, 1, 2, 3))
    assert next(iter(open_kitti(both))).left.ndim == 2
    colour = make_drive(tmp_path / "colour", cameras=(0, 2, 3))
    assert next(iter(open_kitti(colour))).left.ndim == 3


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
    folder = make_drive(tmp_path / "sequences" / "06", 2, cameras)
    (tmp_path / "poses").mkdir()
    # Lines beyond the last image are ignored.
    (folder / place).write_text(poses + IDENTITY)
    with (folder / "times.txt").open("a") as times:
        times.write("0.2\n")
    truth = open_kitti(folder).truth.trajectory
    np.testing.assert_allclose(truth.T_world_camera[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(truth.positions_m, expected, atol=1e-12)
    np.testing.assert_array_equal(truth.timestamps_s, [0, 0.1])


def test_other_files_among_the_images_are_no_frames(tmp_path: Path) -> None:
    folder = make_drive(tmp_path)
    (folder / "image_0" / "Thumbs.db").write_text("x")
    (folder / "image_0" / "._000000.png").write_text("x")
    assert len(open_kitti(folder)) == 3


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


def write(name: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(text) and None


def empty(name: str) -> Callable[[Path], None]:
    return lambda folder: [path.unlink() for path in (folder / name).iterdir()] and None


def drop_folder(name: str) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        empty(name)(folder)
        (folder / name).rmdir()

    return spoil


def empty_both(folder: Path) -> None:
    empty("image_0")(folder)
    empty("image_1")(folder)


@pytest.mark.parametrize(
    ("spoil", "error", "message"),
    [
        (empty("image_1"), SourceError, "image_1: folder contains no images"),
        (empty_both, SourceError, "image_0: folder contains no images"),
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
    tmp_path: Path, spoil: Callable[[Path], None], error: type[ReconError], message: str
) -> None:
    folder = make_drive(tmp_path, poses=IDENTITY * 3)
    spoil(folder)
    with pytest.raises(error, match=message) as caught:
        open_kitti(folder)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_a_rate_stands_in_for_times(tmp_path: Path) -> None:
    folder = make_drive(tmp_path)
    (folder / "times.txt").unlink()
    source = open_kitti(folder, SourceSettings(rate_hz=4.0))
    assert [pair.timestamp_s for pair in source] == [0.0, 0.25, 0.5]
    assert not any(file.name == "times.txt" for file in source.files)


@pytest.mark.parametrize("name", ["image_0/000002.png", "image_1/000001.png"])
def test_an_image_of_another_size_is_named_when_its_turn_comes(tmp_path: Path, name: str) -> None:
    folder = make_drive(tmp_path)
    write_image(folder / name, np.zeros((16, 31), dtype=np.uint8))
    source = open_kitti(folder)
    with pytest.raises(
        CalibrationError, match=rf"{name}: .*another size.*got 31x16, expected 32x16"
    ):
        list(source)


def test_a_truncated_image_is_named_when_its_turn_comes(tmp_path: Path) -> None:
    folder = make_drive(tmp_path)
    path = folder / "image_1" / "000001.png"
    path.write_bytes(path.read_bytes()[:100])
    pairs = iter(open_kitti(folder))
    next(pairs)
    with pytest.raises(FormatError, match=r"000001\.png: PNG image is truncated"):
        next(pairs)


def test_a_missing_folder_is_reported(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="drive: folder does not exist"):
        open_kitti(tmp_path / "drive")
    (tmp_path / "other").mkdir()
    with pytest.raises(SourceError, match="other: folder has no images in KITTI's layout"):
        open_kitti(tmp_path / "other")


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
    assert source.truth.trajectory is not None
    published = read_kitti_poses(folder / "poses.txt")
    assert source.truth.trajectory.path_length_m == pytest.approx(published.path_length_m, abs=1e-6)
    first = next(iter(source))
    assert first.left.shape == (size[1], size[0])
    # The drives are recorded at about 10 Hz.
    assert 0.09 < np.median(np.diff(source.truth.trajectory.timestamps_s)) < 0.12
