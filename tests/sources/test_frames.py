"""Which frames of a drive are pairs: of some, of late cameras, of drives that lost images.

Times, truth and known poses stay those of the left images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import ReconError, SourceError
from recon.core.geometry.se3 import make_transform
from recon.core.values import RectifiedCamera, StereoPair, Trajectory
from recon.io.images.image import write_image
from recon.io.trajectory import FRAMES as FRAME_LIST
from recon.io.trajectory import CapturedFrame
from recon.map.drive.sequence import map_sequence
from recon.rig.audit.audit import audit_source
from recon.rig.cameras import open_camera_source
from recon.rig.capture import CaptureSettings
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from tests.sources import drives
from tests.sources.drives import CAMERA, FRAMES

pytest.importorskip("rosbags", reason="extra ros")
from tests.sources.bags import bag

Pairs = list[StereoPair]
PART = SourceSettings(start=2, end=9, stride=3)
CHOSEN = [2, 5, 8]


def write_kitti(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    """With a true path of a metre per frame."""
    rows = [f"1 0 0 0 0 1 0 0 0 0 1 {pair.index}\n" for pair in pairs]
    drives.write_kitti(pairs, camera, folder)
    (folder / "poses.txt").write_text("".join(rows))
    return folder


def write_folders(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    drives.write_folders(pairs, camera, folder)
    (folder / "times.txt").write_text("".join(f"{pair.timestamp_s}\n" for pair in pairs))
    return folder


def write_one_folder(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    for pair in pairs:
        write_image(folder / f"left{pair.index:02d}.png", pair.left)
        write_image(folder / f"right{pair.index:02d}.png", pair.right)
    write_image(folder / "preview.png", pairs[0].left)
    drives.write_calib(folder, camera)
    return folder


def write_capture(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    """As `recon capture` does; its list counts, though a video lies beside it."""
    drives.write_folders(pairs, camera, folder)
    lines = [
        CapturedFrame(f"left/left{k}.png", f"right/right{k}.png", 0.1 * k, 0.1 * k).line()
        for k in range(len(pairs))
    ]
    (folder / FRAME_LIST).write_text("".join(lines))
    (folder / "preview.mp4").write_bytes(b"")
    return folder


def write_stamped(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    for pair in pairs:
        for side, image in (("cam0", pair.left), ("cam1", pair.right)):
            stamp_us = round((drives.EPOCH_S + pair.timestamp_s) * 1e6)
            write_image(folder / side / f"{stamp_us}.png", image)
    drives.write_calib(folder, camera)
    return folder


LAYOUTS: dict[str, drives.Writer] = {
    "kitti": write_kitti,
    "kitti-raw": drives.write_kitti_raw,
    "euroc": drives.write_euroc,
    "tum": drives.write_tum,
    "folders": write_folders,
    "one folder": write_one_folder,
    "capture": write_capture,
    "stamped": write_stamped,
}
ALL: dict[str, drives.Writer] = {
    **LAYOUTS,
    "side by side": drives.write_side_by_side,
    "two videos": drives.write_two_videos,
    "ros 1": bag(kind="ros1"),
    "mcap": bag(kind="mcap"),
}


def images(folder: Path, side: int) -> list[Path]:
    """The images of one camera in order."""
    marks = (("image_0", "image_00", "cam0", "left"), ("image_1", "image_01", "cam1", "right"))
    found = (
        path
        for path in folder.rglob("*.png")
        if path.stem[:4] == marks[side][3][:4] or {*path.relative_to(folder).parts} & {*marks[side]}
    )
    return sorted(found, key=lambda path: (len(path.name), path.name))


def shown(pair: StereoPair) -> tuple[int, int]:
    """The numbers of the frames that a pair shows; video codecs change grey values a little."""
    left, right = (round(float(view.mean()) / 10) for view in (pair.left, pair.right))
    return left, right


@pytest.mark.parametrize("layout", ALL)
def test_every_layout_gives_a_part_of_itself(numbered: Pairs, tmp_path: Path, layout: str) -> None:
    path = ALL[layout](numbered, CAMERA, tmp_path)
    whole, part = list(open_source(path)), open_source(path, settings=PART)
    found = list(part)
    assert len(part) == len(found) == 3
    assert [shown(pair) for pair in found] == [(k, k) for k in CHOSEN]
    assert [pair.timestamp_s for pair in found] == [whole[k].timestamp_s for k in CHOSEN]
    assert [pair.index for pair in found] == [0, 1, 2]
    assert [shown(pair)[0] for pair in part.frames(1)] == CHOSEN[1:]
    assert list(part.frames(3)) == []
    assert "frames 2 to 8 in steps of 3" in part.description
    assert [part.lines(count) for count in (FRAMES, 3, 4)] == [CHOSEN, [0, 1, 2], None]
    assert part.figures() == {"frames_left_out": 0}
    if part.stamps_s is not None:
        assert part.stamps_s.tolist() == [pair.timestamp_s for pair in found]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_skipped_images_are_not_read(numbered: Pairs, tmp_path: Path, layout: str) -> None:
    path = LAYOUTS[layout](numbered, CAMERA, tmp_path)
    for side in (0, 1):
        for number, image in enumerate(images(tmp_path, side)):
            if number not in CHOSEN:
                image.write_bytes(b"not an image")
    assert [shown(pair)[0] for pair in open_source(path, settings=PART)] == CHOSEN


def test_truth_starts_at_the_first_chosen_frame_and_need_cover_no_others(
    numbered: Pairs, tmp_path: Path
) -> None:
    kitti = write_kitti(numbered, CAMERA, tmp_path / "kitti")
    folder = drives.write_folders(numbered, CAMERA, tmp_path / "folders")
    rows = [f"{0.1 * k:.3f} 0 0 {k} 0 0 0 1\n" for k in range(1, 10)]
    (folder / "groundtruth.txt").write_text("".join(rows))
    assert open_source(folder).truth is None
    for path in (kitti, folder):
        truth = open_source(path, settings=PART).truth.trajectory
        np.testing.assert_allclose(truth.positions_m[:, 2], [0, 3, 6], atol=1e-9)
        np.testing.assert_allclose(truth.timestamps_s, [0.2, 0.5, 0.8], atol=1e-9)


@pytest.mark.parametrize("count", [FRAMES, 3])
def test_known_poses_are_those_of_the_chosen_frames(
    noise: Pairs, tmp_path: Path, count: int
) -> None:
    folder = drives.write_folders(noise[:FRAMES], CAMERA, tmp_path)
    numbers = range(FRAMES) if count == FRAMES else CHOSEN
    poses = [make_transform(np.eye(3), np.array([0.0, 0.0, float(k)])) for k in numbers]
    known = Trajectory(np.stack(poses), np.arange(count, dtype=np.float64))
    source = open_source(folder, settings=PART)
    mapped = map_sequence(source, load_config(), known_poses=known)
    assert mapped.trajectory.positions_m[:, 2].tolist() == [0, 3, 6]


@pytest.mark.parametrize(("start", "end"), [(11, None), (4, 4), (5, 3)])
def test_no_frame_at_all_is_an_error(
    numbered: Pairs, tmp_path: Path, start: int, end: int | None
) -> None:
    folder = drives.write_folders(numbered, CAMERA, tmp_path)
    with pytest.raises(ReconError, match=r"no frame is chosen .*frames from 0 to 10"):
        open_source(folder, settings=SourceSettings(start=start, end=end))


@pytest.mark.parametrize("shift", [-2, 1])
@pytest.mark.parametrize("layout", ALL)
def test_every_layout_pairs_each_left_image_with_the_right_one_of_later(
    numbered: Pairs, tmp_path: Path, layout: str, shift: int
) -> None:
    path = ALL[layout](numbered, CAMERA, tmp_path)
    kept = [k for k in range(FRAMES) if 0 <= k + shift < FRAMES]
    times = [pair.timestamp_s for pair in open_source(path)]
    source = open_source(path, settings=SourceSettings(shift_frames=shift))
    found = list(source)
    assert len(source) == len(kept)
    assert [shown(pair) for pair in found] == [(k, k + shift) for k in kept]
    assert [pair.timestamp_s for pair in found] == [times[k] for k in kept]
    assert [shown(pair) for pair in source.frames(3)] == [(k, k + shift) for k in kept[3:]]
    assert f"right images {shift:+d} frame" in source.description
    assert source.lines(FRAMES) == kept
    assert source.left_out == 0
    part = SourceSettings(shift_frames=shift, start=1, stride=3)
    assert [shown(p)[0] for p in open_source(path, settings=part)] == kept[1::3]


def test_of_cameras_with_different_rates_the_frames_of_the_slower_one_count(
    numbered: Pairs, tmp_path: Path
) -> None:
    folder = write_stamped(numbered, CAMERA, tmp_path)
    for number, path in enumerate(images(folder, 1)):
        if number % 3:
            path.unlink()
    source = open_source(folder, settings=SourceSettings(shift_frames=1))
    assert [shown(pair) for pair in source] == [(0, 3), (3, 6), (6, 9)]


@pytest.mark.parametrize("shift", [FRAMES, -FRAMES, 10**9])
@pytest.mark.parametrize("layout", ["kitti", "euroc", "two videos", "mcap"])
def test_a_shift_that_leaves_no_pair_is_refused(
    numbered: Pairs, tmp_path: Path, layout: str, shift: int
) -> None:
    path = ALL[layout](numbered, CAMERA, tmp_path)
    with pytest.raises(ReconError, match=rf"no pair is left .*shift_frames={shift}, 11 frames"):
        open_source(path, settings=SourceSettings(shift_frames=shift))


def test_cameras_take_no_shift() -> None:
    settings = SourceSettings(shift_frames=1)
    with (
        pytest.raises(ReconError, match=r"shift_frames: images of cameras are paired as they are"),
        open_camera_source(["0", "1"], CaptureSettings(), settings),
    ):
        pass


@pytest.fixture(scope="module")
def street() -> tuple[Pairs, RectifiedCamera]:
    return drives.rendered(9, width_px=320, height_px=160, focal_px=190.0)


def counted(pairs: Pairs) -> Pairs:
    """The pairs, counted from 0 at time 0."""
    return [replace(p, index=k, timestamp_s=0.1 * k) for k, p in enumerate(pairs)]


@pytest.mark.parametrize("frames", [-1, 1, 2])
def test_the_audit_names_the_shift_with_which_a_late_drive_is_mapped_as_if_it_were_not(
    street: tuple[Pairs, RectifiedCamera], tmp_path: Path, frames: int
) -> None:
    drive, camera = street
    late = [
        replace(pair, right=drive[pair.index - frames].right)
        for pair in drive
        if 0 <= pair.index - frames < len(drive)
    ]
    folder = drives.write_kitti(counted(late), camera, tmp_path / "late")
    findings = audit_source(open_source(folder), load_config(), quick=True).findings
    (finding,) = (one for one in findings if one.code == "lag")
    assert f"--set source.shift_frames={frames} " in finding.text
    shifted = open_source(folder, settings=SourceSettings(shift_frames=frames))
    known = [p for p in drive if abs(frames) <= p.index < len(drive) - abs(frames)]
    same = drives.write_kitti(counted(known), camera, tmp_path / "known")
    mapped, expected = (
        map_sequence(source, load_config()).trajectory.positions_m
        for source in (shifted, open_source(same))
    )
    # Their times begin elsewhere, which rounds.
    np.testing.assert_allclose(mapped, expected, atol=1e-6)


def test_the_advice_counts_what_is_shifted_already_and_frames_that_are_left_out(
    numbered: Pairs, tmp_path: Path
) -> None:
    folder = drives.write_kitti(numbered, CAMERA, tmp_path)
    source = open_source(folder, settings=SourceSettings(shift_frames=1, stride=2))
    assert source.shift_of(-2) == -3


@pytest.mark.parametrize("layout", LAYOUTS)
def test_frames_without_a_partner_are_left_out_and_counted(
    numbered: Pairs, tmp_path: Path, layout: str
) -> None:
    folder = LAYOUTS[layout](numbered, CAMERA, tmp_path)
    images(folder, 0)[7].unlink()
    images(folder, 1)[4].unlink()
    source = open_source(folder)
    kept = [0, 1, 2, 3, 5, 6, 8, 9, 10]
    assert [shown(pair) for pair in source] == [(k, k) for k in kept]
    assert source.left_out == 2
    assert source.figures() == {"frames_left_out": 2}
    assert source.warnings() == ["2 images without a partner: left out"]
    assert "1 left and 1 right without a partner left out" in source.description
    # Stamps in microseconds.
    times = source.stamps_s - source.stamps_s[0]
    np.testing.assert_allclose(times, 0.1 * np.array(kept), atol=2e-6)
    if source.truth is not None and source.truth.trajectory is not None:
        assert source.truth.trajectory.positions_m[:, 2].tolist() == kept
    assert source.lines(FRAMES) == kept
    assert source.lines(len(kept)) == list(range(len(kept)))
    # With a shift a lost image costs its pair and moves no other.
    late = open_source(folder, settings=SourceSettings(shift_frames=1))
    assert [shown(pair) for pair in late] == [(k, k + 1) for k in (0, 1, 2, 4, 5, 6, 8, 9)]
    assert late.left_out == 2


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name != "stamped"])
def test_most_images_missing_is_an_error(numbered: Pairs, tmp_path: Path, layout: str) -> None:
    folder = LAYOUTS[layout](numbered, CAMERA, tmp_path)
    # Stamped names may also be those of a slower camera.
    for path in images(folder, 1)[1:7]:
        path.unlink()
    with pytest.raises(SourceError, match=r"most images have no partner|numbers of left and right"):
        open_source(folder)


def extra_left(folder: Path) -> None:
    write_image(folder / "image_0" / "000011.png", np.full((32, 64), 8, np.uint8))


def unpaired_row(folder: Path) -> None:
    path = folder / "mav0" / "cam0" / "data.csv"
    path.write_text(path.read_text() + f"{(drives.EPOCH_S + 5) * 10**9},nowhere.png\n")


@pytest.mark.parametrize(
    ("write", "spoil"), [(write_kitti, extra_left), (drives.write_euroc, unpaired_row)]
)
def test_one_stray_entry_stops_nothing(
    numbered: Pairs, tmp_path: Path, write: drives.Writer, spoil: Callable[[Path], None]
) -> None:
    folder = write(numbered, CAMERA, tmp_path)
    spoil(folder)
    source = open_source(folder)
    assert len(list(source)) == FRAMES
    assert source.left_out == 1
