"""A part of a drive, or every so many frames of it: times, truth and poses stay those of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import ReconError
from recon.core.geometry.se3 import make_transform
from recon.core.values import RectifiedCamera, StereoPair, Trajectory
from recon.io.images.image import write_image
from recon.map.drive.sequence import map_sequence
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from tests.sources import drives
from tests.sources.test_stray_frames import LAYOUTS, images

pytest.importorskip("rosbags", reason="extra ros")
from tests.sources.bags import Recording, write_bag

CAMERA = RectifiedCamera(60.0, 31.5, 15.5, 31.5, 0.5, 64, 32)
FRAMES = 11
PART = SourceSettings(start=2, end=9, stride=3)
CHOSEN = [2, 5, 8]


def bag(kind: str) -> drives.Writer:
    return lambda pairs, camera, folder: write_bag(pairs, camera, folder, Recording(kind))


ALL: dict[str, drives.Writer] = {
    **LAYOUTS,
    "side by side": drives.write_side_by_side,
    "two videos": drives.write_two_videos,
    "ros 1": bag("ros1"),
    "mcap": bag("mcap"),
}


@pytest.fixture(scope="module")
def pairs() -> list[StereoPair]:
    """The grey value of both images is ten times the number of the frame."""
    grey = (np.full((32, 64), 10 * index, np.uint8) for index in range(FRAMES))
    return [StereoPair(image, image, 0.1 * k, k) for k, image in enumerate(grey)]


def shown(pair: StereoPair) -> int:
    """The number of the frame that a pair shows; video codecs change grey values a little."""
    return round(float(pair.right.mean()) / 10)


@pytest.mark.parametrize("layout", ALL)
def test_every_layout_gives_a_part_of_itself(
    pairs: list[StereoPair], tmp_path: Path, layout: str
) -> None:
    path = ALL[layout](pairs, CAMERA, tmp_path)
    whole, part = list(open_source(path)), open_source(path, settings=PART)
    found = list(part)
    assert len(part) == len(found) == 3
    assert [shown(pair) for pair in found] == CHOSEN
    assert [pair.timestamp_s for pair in found] == [whole[k].timestamp_s for k in CHOSEN]
    assert [pair.index for pair in found] == [0, 1, 2]
    assert [shown(pair) for pair in part.frames(1)] == CHOSEN[1:]
    assert list(part.frames(3)) == []
    assert "frames 2 to 8 in steps of 3" in part.description
    assert part.lines(FRAMES) == CHOSEN
    assert part.lines(3) == [0, 1, 2]
    assert part.lines(4) is None
    if part.stamps_s is not None:
        assert part.stamps_s.tolist() == [pair.timestamp_s for pair in found]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_skipped_images_are_not_read(pairs: list[StereoPair], tmp_path: Path, layout: str) -> None:
    path = LAYOUTS[layout](pairs, CAMERA, tmp_path)
    for side in (0, 1):
        for number, image in enumerate(images(tmp_path, side)):
            if number not in CHOSEN:
                image.write_bytes(b"not an image")
    assert [shown(pair) for pair in open_source(path, settings=PART)] == CHOSEN


def test_ground_truth_starts_at_the_first_chosen_frame(
    pairs: list[StereoPair], tmp_path: Path
) -> None:
    truth = open_source(LAYOUTS["kitti"](pairs, CAMERA, tmp_path), settings=PART).truth
    assert truth is not None
    assert truth.trajectory is not None
    # One metre per frame.
    assert truth.trajectory.positions_m[:, 2].tolist() == [0, 3, 6]
    np.testing.assert_allclose(truth.trajectory.timestamps_s, [0.2, 0.5, 0.8], atol=1e-9)


def test_truth_that_covers_the_chosen_frames_alone_is_used(
    pairs: list[StereoPair], tmp_path: Path
) -> None:
    folder = drives.write_folders(pairs, CAMERA, tmp_path)
    rows = [f"{0.1 * k:.3f} 0 0 {k} 0 0 0 1\n" for k in range(1, 10)]
    (folder / "groundtruth.txt").write_text("".join(rows))
    assert open_source(folder).truth is None
    truth = open_source(folder, settings=PART).truth
    assert truth is not None
    assert truth.trajectory is not None
    np.testing.assert_allclose(truth.trajectory.positions_m[:, 2], [0, 3, 6], atol=1e-9)


@pytest.mark.parametrize("count", [FRAMES, 3])
def test_known_poses_are_those_of_the_chosen_frames(tmp_path: Path, count: int) -> None:
    rng = np.random.default_rng(0)
    noise = [
        StereoPair(*rng.integers(0, 256, (2, 32, 64), dtype=np.uint8), 0.1 * k, k)
        for k in range(FRAMES)
    ]
    source = open_source(drives.write_folders(noise, CAMERA, tmp_path), settings=PART)
    numbers = range(FRAMES) if count == FRAMES else CHOSEN
    poses = [make_transform(np.eye(3), np.array([0.0, 0.0, float(k)])) for k in numbers]
    known = Trajectory(np.stack(poses), np.arange(count, dtype=np.float64))
    mapped = map_sequence(source, load_config(), known_poses=known)
    assert mapped.trajectory.positions_m[:, 2].tolist() == [0, 3, 6]


@pytest.mark.parametrize(("start", "end"), [(11, None), (4, 4), (5, 3)])
def test_no_frame_at_all_is_an_error(
    pairs: list[StereoPair], tmp_path: Path, start: int, end: int | None
) -> None:
    folder = drives.write_folders(pairs, CAMERA, tmp_path)
    with pytest.raises(ReconError, match=r"no frame is chosen .*frames from 0 to 10"):
        open_source(folder, settings=SourceSettings(start=start, end=end))


def test_one_pair_has_no_second_frame(tmp_path: Path) -> None:
    for name in ("im0.png", "im1.png"):
        write_image(tmp_path / name, np.zeros((16, 32), np.uint8))
    (tmp_path / "calib.txt").write_text(
        "cam0=[700 0 16; 0 700 8; 0 0 1]\ncam1=[700 0 18; 0 700 8; 0 0 1]\n"
        "doffs=2\nbaseline=500\nwidth=32\nheight=16\nndisp=20\n"
    )
    assert len(open_source(tmp_path, settings=SourceSettings(end=1))) == 1
    with pytest.raises(ReconError, match="no frame is chosen"):
        open_source(tmp_path, settings=SourceSettings(start=1))
