"""Faulty inputs are reported in one line, before a run starts if possible."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon.core.errors import ReconError
from recon.core.values import RectifiedCamera, StereoPair
from recon.io.images.image import write_image
from recon.io.images.video import VideoFile
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from recon.sources.video import view_size
from tests.hostile.refusals import assert_refused, run
from tests.sources import drives

pytest.importorskip("rosbags", reason="extra ros")
from tests.sources.bags import TOPICS, Recording, bag, recorder

Drive = tuple[list[StereoPair], RectifiedCamera]


@pytest.fixture
def drive(noise: list[StereoPair]) -> Drive:
    return noise, drives.CAMERA


def fails(path: Path, message: str, settings: SourceSettings | None = None) -> None:
    with pytest.raises(ReconError, match=message) as caught:
        list(open_source(path, settings=settings))
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value) or path.name in str(caught.value)


def halve(path: Path, share: float = 0.5) -> Path:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    return path


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9])
def test_a_cut_off_recording_is_one_line(
    drive: Drive, tmp_path: Path, kind: str, share: float
) -> None:
    path = bag(kind=kind)(*drive, tmp_path)
    halve(next(path.glob("*.db3")) if kind == "ros2" else path, share)
    fails(path, "recording cannot be read.*reindex")


def test_a_recording_cut_off_before_its_index_was_written_is_one_line(
    drive: Drive, tmp_path: Path
) -> None:
    # A recorder that was killed leaves the place of the index at 0.
    path = bag(kind="ros1")(*drive, tmp_path)
    content = path.read_bytes()
    at = content.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(content[:at] + bytes(8) + content[at + 8 :])
    fails(path, "recording cannot be read.*not indexed.*rosbag reindex")


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
def test_stamps_out_of_order_are_reported_with_topic_and_place(
    drive: Drive, tmp_path: Path, kind: str
) -> None:
    pairs, _ = drive
    mixed = [*pairs[:5], pairs[6], pairs[5], *pairs[7:]]
    with recorder(tmp_path, Recording(kind)) as made:
        for number, pair in enumerate(mixed):
            stamp = round(pair.timestamp_s * 1e9) + 10**18
            made.write(TOPICS[0], number * 10**8, made.image(stamp, pair.left))
            made.write(TOPICS[1], number * 10**8, made.image(stamp, pair.right))
    path = next(p for p in tmp_path.rglob("*") if p.suffix in {".bag", ".mcap", ".db3"})
    fails(path, r"image_rect, image 6: timestamps are out of order")


@pytest.mark.parametrize(
    ("how", "settings", "message"),
    [
        ({}, {"left": "/front/image", "right": TOPICS[1]},
         r"no such image topic \(got /front/image, expected .*image_rect \(12\)"),
        ({"topics": ("/front/image", "/rear/image")}, {},
         r"no image topics of a left and a right camera.*/front/image \(12\), /rear/image"),
        ({"info": False}, {}, "no calibration of both cameras.*--calib"),
        ({"encoding": "32FC1"}, {}, "message 0: image encoding is not supported.*got 32FC1"),
    ],
)  # fmt: skip
def test_what_a_recording_lacks_is_said_with_what_it_has(
    drive: Drive, tmp_path: Path, how: dict[str, Any], settings: dict[str, str], message: str
) -> None:
    path = bag(kind="ros1", **how)(*drive, tmp_path)
    fails(path, message, SourceSettings(**settings))


def test_topics_and_calibration_can_be_named(drive: Drive, tmp_path: Path) -> None:
    names = ("/front/image", "/rear/image")
    path = bag(kind="mcap", topics=names, info=False)(*drive, tmp_path)
    calib = str(drives.write_calib(tmp_path / "calibration", drive[1]))
    settings = SourceSettings(left=names[0], right=names[1], calibration=calib)
    source = open_source(path, settings=settings)
    assert len(list(source)) == 12
    assert source.files[0] == Path(calib)


def test_of_several_pairs_of_topics_the_rectified_one_is_taken_and_the_other_named(
    drive: Drive, tmp_path: Path
) -> None:
    pairs, camera = drive
    raw = ("/stereo/left/image_raw", "/stereo/right/image_raw")
    with recorder(tmp_path, Recording("ros1")) as made:
        for pair in pairs:
            stamp = round(pair.timestamp_s * 1e9) + 10**18
            for topics in (raw, TOPICS):
                for topic, P in zip(topics, drives.projections(camera), strict=True):
                    made.write(topic, stamp, made.image(stamp, pair.left))
                    place = topic.rsplit("/", 1)[0]
                    made.write(f"{place}/camera_info", stamp, made.camera_info(stamp, camera, P))
    description = open_source(tmp_path / "drive.bag").description
    assert f"{TOPICS[0]} and {TOPICS[1]}" in description
    assert f"also there: {raw[0]}" in description


def test_headers_without_stamps_fall_back_to_the_recording_times(
    drive: Drive, tmp_path: Path
) -> None:
    path = bag(kind="ros1", stamped=False)(*drive, tmp_path)
    # The right images are recorded 104 ms late here: nothing pairs within 10 ms ...
    source = open_source(path, settings=SourceSettings(tolerance_s=0.11))
    # ... and where the recording alone tells the times, that is said.
    assert "recording times" in source.description


@pytest.mark.parametrize(
    ("write", "victim", "share", "message"),
    [
        (drives.write_lossy_videos, "left.mp4", 0.5, "not a readable video"),
        (drives.write_two_videos, "right.avi", 0.5, "video is truncated"),
        (drives.write_side_by_side, "both.mkv", 0.0, "not a readable video"),
        (drives.write_two_videos, "left.avi", 0.01, "video"),
    ],
)
def test_a_video_that_cannot_be_read_is_one_line(
    drive: Drive, tmp_path: Path, write: drives.Writer, victim: str, share: float, message: str
) -> None:
    path = write(*drive, tmp_path)
    halve(tmp_path / victim, share)
    fails(path, message)


def test_videos_of_different_length_are_refused(drive: Drive, tmp_path: Path) -> None:
    pairs, camera = drive
    drives.write_two_videos(pairs, camera, tmp_path)
    drives.write_video(tmp_path / "right.avi", [pair.right for pair in pairs[:-2]])
    fails(tmp_path, r"different numbers of frames \(got left 12, right 10\)")


@pytest.mark.parametrize("shorter", ["left", "right"])
def test_a_video_that_ends_a_little_earlier_is_mapped_as_far_as_it_goes(
    drive: Drive, tmp_path: Path, shorter: str
) -> None:
    camera = drive[1]
    pairs = [pair for pair in drive[0] for _ in range(2)]
    drives.write_two_videos(pairs, camera, tmp_path)
    views = [getattr(pair, shorter) for pair in pairs[:-1]]
    drives.write_video(tmp_path / f"{shorter}.avi", views)
    source = open_source(tmp_path)
    assert source.left_out == 1
    assert "1 right" in source.description or "1 left" in source.description
    assert len(list(source)) == len(source) == 23


def test_numbers_of_images_that_differ_are_refused_where_names_give_no_answer(
    drive: Drive, tmp_path: Path
) -> None:
    drives.write_folders(*drive, tmp_path)
    for number, path in enumerate(sorted((tmp_path / "right").iterdir())[1:]):
        path.rename(path.with_stem(f"photo{100 + 7 * number}"))
    (tmp_path / "right" / "right0.png").unlink()
    fails(tmp_path, r"numbers of left and right images differ \(got 12 left and 11 right")


def test_stamps_that_never_meet_tell_how_far_they_are_apart(drive: Drive, tmp_path: Path) -> None:
    pairs, camera = drive
    drives.write_stamped(pairs[:1], camera, tmp_path)
    settings = SourceSettings(tolerance_s=0.001)
    fails(
        tmp_path, r"no left and right images were taken at the same time.*0\.002 s apart", settings
    )


def test_a_video_that_cannot_be_halved_is_reported() -> None:
    video = VideoFile(Path("both.avi"), frames=3, width_px=127, height_px=32, rate_hz=10.0)
    with pytest.raises(ReconError, match=r"both.avi: .*cannot be halved \(got 127x32\)"):
        view_size(video, SourceSettings())
    assert view_size(video, SourceSettings(side_by_side="top-bottom")) == (127, 16)


def test_a_calibration_of_another_size_is_reported(drive: Drive, tmp_path: Path) -> None:
    drives.write_euroc(*drive, tmp_path)
    for path in tmp_path.rglob("*.png"):
        write_image(path, np.zeros((16, 32), np.uint8))
    with pytest.raises(ReconError, match=r"images have another size.*got 32x16, expected 64x32"):
        open_source(tmp_path)


def test_no_calibration_is_reported_with_the_option(drive: Drive, tmp_path: Path) -> None:
    drives.write_folders(*drive, tmp_path)
    (tmp_path / "calib.txt").unlink()
    fails(tmp_path, r"calibration is missing.*--calib FILE")


@pytest.mark.parametrize("kind", ["ros1", "mcap", "video"])
def test_the_command_line_tells_it_in_one_line_and_leaves_nothing(
    drive: Drive, tmp_path: Path, kind: str
) -> None:
    if kind == "video":
        path = drives.write_lossy_videos(*drive, tmp_path / "in")
        halve(path / "left.mp4")
    else:
        path = halve(bag(kind=kind)(*drive, tmp_path / "in"))
    done = run("map", path, "--out", tmp_path / "out")
    assert_refused(done)
    assert done.err.count("\n") == 1
    assert not (tmp_path / "out").exists()
