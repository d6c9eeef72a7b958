"""Details of single layouts: raw lenses, ground truth, names, times, encodings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import CalibrationError, FormatError, ReconError, SourceError
from recon.core.geometry.se3 import make_transform
from recon.core.values import CameraIntrinsics, StereoCalibration, StereoPair
from recon.io.cameras.ros import write_kalibr
from recon.io.images.image import write_image
from recon.sources.bag import rig_of_messages
from recon.sources.calibration import camera_of_numbers
from recon.sources.image_names import find_partners
from recon.sources.opencv_camera import Camera
from recon.sources.registry import open_source
from recon.sources.rosbags import BagCameraInfo
from recon.sources.settings import SourceSettings
from recon.sources.times import pair_stamps, stamp_of_name
from tests.sources import drives
from tests.sources.drives import CAMERA


def test_an_unrectified_kitti_drive_gets_its_raw_lenses(
    noise: list[StereoPair], tmp_path: Path
) -> None:
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


@pytest.mark.parametrize("tag", ["", "!!opencv-matrix"])
def test_sensor_yaml_may_have_the_header_of_opencv(
    noise: list[StereoPair], tmp_path: Path, tag: str
) -> None:
    drives.write_euroc(noise, CAMERA, tmp_path)
    for path in tmp_path.rglob("sensor.yaml"):
        text = path.read_text().replace("T_BS:", f"T_BS: {tag}")
        path.write_text("%YAML:1.0\n---\n" + text)
    assert open_source(tmp_path).calibration == CAMERA


def test_a_euroc_drive_without_sensor_yaml_takes_the_camchain_beside_it(
    noise: list[StereoPair], tmp_path: Path
) -> None:
    """As TUM VI is published."""
    drives.write_euroc(noise, CAMERA, tmp_path)
    left = CameraIntrinsics(CAMERA.matrix, np.zeros(4), 64, 32)
    T = make_transform(np.eye(3), np.array([-CAMERA.baseline_m, 0, 0]))
    (tmp_path / "dso").mkdir()
    write_kalibr(tmp_path / "dso" / "camchain.yaml", StereoCalibration(left, left, T))
    for path in tmp_path.rglob("sensor.yaml"):
        path.unlink()
    assert open_source(tmp_path).calibration == CAMERA
    (tmp_path / "dso" / "camchain.yaml").unlink()
    with pytest.raises(ReconError, match=r"calibration is missing.*--calib"):
        open_source(tmp_path)


@pytest.mark.parametrize("rectified", [True, False])
@pytest.mark.parametrize(
    ("focal_px", "message"),
    [
        (60.0, "CameraInfo has no baseline.*--calib"),
        (0.0, "CameraInfo is of .* not calibrated.*--calib"),
    ],
)
def test_messages_without_baseline_or_focal_length_are_refused(
    rectified: bool, focal_px: float, message: str
) -> None:
    K = np.diag([focal_px, focal_px, 1.0])
    P = np.hstack([K, np.zeros((3, 1))])
    info = BagCameraInfo(64, 32, "plumb_bob", np.zeros(5), K, np.eye(3), P)
    with pytest.raises(ReconError, match=rf"drive\.bag: {message}"):
        rig_of_messages(info, info, Path("drive.bag"), rectified)


def test_numbers_alone_make_a_camera_that_looks_through_the_middle() -> None:
    known = SourceSettings(focal_px=60.0, baseline_m=0.5)
    assert camera_of_numbers(known, (64, 32)) == CAMERA
    shifted = camera_of_numbers(known.model_copy(update={"cx_px": 3.0, "cy_px": 7.0}), (64, 32))
    assert (shifted.cx_px, shifted.cx_right_px, shifted.cy_px) == (3.0, 3.0, 7.0)
    for wrong in (SourceSettings(focal_px=60.0), SourceSettings(focal_px=2.0, baseline_m=0.5)):
        with pytest.raises(CalibrationError, match="--focal"):
            camera_of_numbers(wrong, (64, 32))
    camera_of_numbers(known.model_copy(update={"focal_px": 4.5}), (64, 32))  # sees 164 degrees


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(
    ("write", "names"),
    [(drives.write_tum, ("left.txt", "right.txt")),
     (drives.write_two_videos, ("left.avi", "right.avi"))],
)  # fmt: skip
def test_lists_and_videos_can_be_named_and_one_name_alone_is_not_enough(
    noise: list[StereoPair],
    tmp_path: Path,
    write: drives.Writer,
    names: tuple[str, str],
    side: str,
) -> None:
    folder = write(noise, CAMERA, tmp_path)
    for view, name in zip(("port", "starboard"), names, strict=True):
        (folder / name).rename(folder / f"{view}{name[-4:]}")
    kind = "tum" if names[0].endswith("txt") else "video"
    named = {"left": f"port{names[0][-4:]}", "right": f"starboard{names[1][-4:]}"}
    assert len(list(open_source(folder, kind, SourceSettings(**named)))) == 12
    with pytest.raises(SourceError, match="name them with --left and --right"):
        open_source(folder, kind, SourceSettings(**{side: named[side]}))
    for view, name in (("port", names[0]), ("starboard", names[1])):
        (folder / f"{view}{name[-4:]}").rename(folder / name)
    assert len(open_source(folder, kind)) == 12
    named = {"left": names[0], "right": names[1]}  # also of those that are found without a name
    with pytest.raises(SourceError, match=rf"only one .*got --{side} {named[side]}.* --left and"):
        open_source(folder, kind, SourceSettings(**{side: named[side]}))


def test_two_videos_must_advance_alike(noise: list[StereoPair], tmp_path: Path) -> None:
    source = open_source(drives.write_two_videos(noise, CAMERA, tmp_path))
    for drift_s in (0.049, -0.049):
        source._check_pace(3, drift_s)
    for drift_s in (0.051, -0.051):
        with pytest.raises(SourceError, match=rf"right\.avi, frame 3: .*{drift_s}"):
            source._check_pace(3, drift_s)


def test_a_video_file_can_take_the_place_of_a_camera(
    noise: list[StereoPair], tmp_path: Path
) -> None:
    camera = Camera(str(drives.write_video(tmp_path / "left.avi", [p.left for p in noise])))
    assert not camera.live
    assert camera.rate_hz == pytest.approx(10.0)
    assert camera.lock(None) is None
    times = []
    while (time_s := camera.grab()) is not None:
        times.append(time_s)
        np.testing.assert_array_equal(camera.retrieve()[:, :, 0], noise[len(times) - 1].left)
    np.testing.assert_allclose(times, 0.1 * np.arange(12), atol=1e-6)
    camera.close()


def test_the_true_path_of_euroc_is_that_of_the_left_camera(
    noise: list[StereoPair], tmp_path: Path
) -> None:
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


@pytest.mark.real
def test_the_chessboard_images_of_opencv_are_pairs(recon_data: Path) -> None:
    source = open_source(recon_data / "calibration" / "opencv_chessboard")
    pairs = list(source)
    assert [pair.name for pair in pairs[7:10]] == ["left08.jpg", "left09.jpg", "left11.jpg"]
    assert isinstance(source.calibration, StereoCalibration)


def test_folders_of_any_name_and_place_can_be_named(
    noise: list[StereoPair], tmp_path: Path
) -> None:
    for pair in noise:
        write_image(tmp_path / "port" / f"{pair.index}.png", pair.left)
        write_image(tmp_path / "starboard" / f"{pair.index}.png", pair.right)
    calib = drives.write_calib(tmp_path / "papers", CAMERA)
    inside = SourceSettings(left="port", right="starboard", calibration=str(calib))
    beside = SourceSettings(right=str(tmp_path / "starboard"), calibration=str(calib))
    for path, settings in ((tmp_path, inside), (tmp_path / "port", beside)):
        np.testing.assert_array_equal(
            list(open_source(path, "folders", settings))[11].right, noise[11].right
        )


@pytest.mark.parametrize("left", ["front_left", "rear_left", None])
def test_of_several_pairs_of_folders_one_can_be_named(
    noise: list[StereoPair], tmp_path: Path, left: str | None
) -> None:
    for number, side in enumerate(("front_left", "front_right", "rear_left", "rear_right")):
        for k in range(3):
            write_image(tmp_path / side / "data" / f"{k}.png", noise[4 * k + number].left)
    drives.write_calib(tmp_path, CAMERA)
    pair = list(open_source(tmp_path, settings=SourceSettings(left=left)))[2]
    first = 10 if left == "rear_left" else 8
    np.testing.assert_array_equal(pair.left, noise[first].left)
    np.testing.assert_array_equal(pair.right, noise[first + 1].left)


@pytest.mark.parametrize(
    ("layout", "flip", "stack"),
    [("right-left", True, np.hstack), ("top-bottom", False, np.vstack),
     ("bottom-top", True, np.vstack)],
)  # fmt: skip
def test_views_may_stand_in_any_order_in_one_video(
    noise: list[StereoPair], tmp_path: Path, layout: str, flip: bool, stack: object
) -> None:
    images = [[p.left, p.right][:: -1 if flip else 1] for p in noise]
    drives.write_calib(tmp_path, CAMERA)
    path = drives.write_video(tmp_path / "both.avi", [stack(both) for both in images])  # type: ignore[operator]
    read = list(open_source(path, settings=SourceSettings(side_by_side=layout)))  # type: ignore[arg-type]
    np.testing.assert_array_equal(read[3].left[:, :, 0], noise[3].left)
    np.testing.assert_array_equal(read[3].right[:, :, 0], noise[3].right)


@pytest.mark.parametrize(
    ("stem", "seconds"),
    [("1305031102.175304", 1305031102.175304), ("1403636579763555584", 1403636579.763555584),
     ("1600000000123", 1600000000.123), ("1600000000123456", 1600000000.123456),
     ("0.25", 0.25), ("000012", None), ("left01", None), ("1_5", None)],
)  # fmt: skip
def test_names_that_are_stamps_are_distinguished_from_counts(
    stem: str, seconds: float | None
) -> None:
    assert stamp_of_name(stem) == (seconds if seconds is None else pytest.approx(seconds, abs=1e-6))


def test_partners_are_found_among_names_of_many_rigs() -> None:
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


@given(
    st.lists(st.integers(0, 10_000), min_size=1, max_size=30, unique=True),
    st.lists(st.integers(0, 10_000), min_size=1, max_size=30, unique=True),
    st.integers(1, 300),
)
def test_pairs_by_stamp_are_near_mutual_and_in_order(
    left: list[int], right: list[int], tolerance: int
) -> None:
    ours, theirs = (np.array(sorted(s), dtype=np.float64) for s in (left, right))
    apart = np.abs(ours[:, None] - theirs[None])
    near = (apart == apart.min(0)) & (apart == apart.min(1)[:, None]) & (apart <= tolerance)
    try:
        frames = pair_stamps(ours, theirs, float(tolerance), Path("here"))
    except ReconError:
        assert 2 * near.any(1).sum() < min(near.shape) or not near.any()
        return
    pairs = [(i, j) for i, j in frames if i is not None and j is not None]
    assert all(near[pair] for pair in pairs)
    for side in (0, 1):  # each image once, in order
        found = [frame[side] for frame in frames if frame[side] is not None]
        assert found == list(range(near.shape[side]))
    times = [ours[i] if i is not None else theirs[j] for i, j in frames]
    assert times == sorted(times)


def write_named(folder: Path, names: list[str]) -> Path:
    """Pairs of equal names in two folders, the grey values counting the frames."""
    for number, name in enumerate(names):
        for side in ("left", "right"):
            write_image(folder / side / f"{name}.png", np.full((32, 64), number, np.uint8))
    drives.write_calib(folder, CAMERA)
    return folder


def times(folder: Path, **settings: object) -> list[float]:
    source = open_source(folder, "folders", SourceSettings.model_validate(settings))
    return source.stamps_s.tolist()


@pytest.mark.parametrize("digits", [10, 13, 16, 19])
@pytest.mark.parametrize(("step", "count"), [(1, 4), (5, 4), (1, 1)])
def test_padded_counters_are_no_times(tmp_path: Path, digits: int, step: int, count: int) -> None:
    folder = write_named(tmp_path, [f"{100 + step * k:0{digits}d}" for k in range(count)])
    assert times(folder) == [0.0, 0.1, 0.2, 0.3][:count]
    assert "no times: assumed 10 Hz" in open_source(folder).description


# The last one is nanoseconds since a simulation began.
@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["1600000000", "1600000001"], [1600000000, 1600000001]),
        (["1600000000123", "1600000000156"], [1600000000.123, 1600000000.156]),
        (["0000000000000000000", "0000000000050000000"], [0.0, 0.05]),
    ],
)
def test_integer_times_stay_times(tmp_path: Path, names: list[str], expected: list[float]) -> None:
    assert times(write_named(tmp_path, names)) == pytest.approx(expected, abs=1e-6)


def test_a_times_file_may_have_numbers_and_exposures(tmp_path: Path) -> None:
    folder = write_named(tmp_path, [f"{k:05d}" for k in range(4)])
    rows = [f"{k:05d} {7 + 0.25 * k:.6f} 1.5e-3\n" for k in range(4)]
    (folder / "times.txt").write_text("".join(rows))
    assert times(folder) == [7.0, 7.25, 7.5, 7.75]
    (folder / "times.txt").write_text("".join([*rows[:2], rows[1], rows[3]]))
    with pytest.raises(SourceError, match=r"times\.txt:3: two images have the same timestamp"):
        times(folder)
    (folder / "times.txt").write_text("1 2\n3 4\n")
    with pytest.raises(FormatError, match="got 2, expected 1 or 3"):
        times(folder)


@pytest.mark.parametrize("name", ["{:010d}", "16000000{:02d}", "{}.5", "frame{}"])
@pytest.mark.parametrize("place", [".", "left"])
def test_a_times_file_wins_over_names(tmp_path: Path, name: str, place: str) -> None:
    folder = write_named(tmp_path, [name.format(k) for k in range(4)])
    (folder / place / "times.txt").write_text("7.0\n7.25\n7.5\n7.75\n")
    assert times(folder) == [7.0, 7.25, 7.5, 7.75]
    assert folder / place / "times.txt" in open_source(folder).files
    assert times(folder, rate_hz=5.0) == pytest.approx([0, 0.2, 0.4, 0.6])
