"""A drive is the same in every layout, and so is a part of it, a late one, and what is left of it.

Times, truth and known poses stay those of the left images.
"""

import os
import shutil
import tracemalloc
from dataclasses import replace
from functools import partial
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
from recon.rig.audit import audit_source
from recon.rig.capture import CaptureSettings, open_camera_source
from recon.sources.registry import open_source, recognise_source
from recon.sources.settings import SourceSettings
from recon.sources.source import mark_of
from tests.hostile.refusals import refusal
from tests.sources import drives
from tests.sources.drives import CAMERA, FRAMES, Pairs, Writer

pytest.importorskip("rosbags", reason="extra ros")
from tests.sources.bags import bag

Drive = tuple[Pairs, RectifiedCamera]
Written = dict[str, Path]
PART = SourceSettings(start=2, end=9, stride=3)
CHOSEN = [2, 5, 8]


def write_kitti(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    """With a true path of a metre per frame."""
    drives.write_kitti(pairs, camera, folder)
    rows = [f"1 0 0 0 0 1 0 0 0 0 1 {pair.index}\n" for pair in pairs]
    (folder / "poses.txt").write_text("".join(rows))
    return folder


def write_folders(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    drives.write_folders(pairs, camera, folder)
    (folder / "times.txt").write_text("".join(f"{pair.timestamp_s}\n" for pair in pairs))
    return folder


def write_one_folder(pairs: Pairs, camera: RectifiedCamera, folder: Path) -> Path:
    write_image(folder / "preview.png", pairs[0].left)
    sides = ("left", "right")
    return drives.write_images(pairs, camera, folder, lambda n, p: f"{sides[n]}{p.index:02d}")


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


IN_IMAGES: dict[str, Writer] = {
    "kitti": write_kitti,
    "kitti-raw": drives.write_kitti_raw,
    "euroc": drives.write_euroc,
    "tum": drives.write_tum,
    "folders": write_folders,
    "one folder": write_one_folder,
    "capture": write_capture,
    "stamped": partial(drives.write_stamped, late_us=0, lonely=False),
}
ALL: dict[str, Writer] = {
    **IN_IMAGES,
    "side by side": drives.write_side_by_side,
    "two videos": drives.write_two_videos,
    "ros 1": bag(kind="ros1"),
    "mcap": bag(kind="mcap"),
}
MORE: dict[str, Writer] = {
    **ALL,
    "folders without times": drives.write_folders,
    "stamped late": drives.write_stamped,
    "ros 2": bag(kind="ros2"),
    "ros 2 compressed": bag(kind="ros2", compressed=True),
}
KINDS = {
    **{name: name for name in ("kitti", "kitti-raw", "euroc", "tum")},
    **dict.fromkeys(("side by side", "two videos"), "video"),
    **dict.fromkeys(("ros 1", "mcap", "ros 2", "ros 2 compressed"), "bag"),
}


@pytest.fixture(scope="module")
def drive():
    return drives.rendered(FRAMES, width_px=320, height_px=128, focal_px=180.0, smooth_edges=False)


@pytest.fixture(scope="module")
def written(drive, tmp_path_factory):
    folder = tmp_path_factory.mktemp("drives")
    return {name: write(*drive, folder / name) for name, write in MORE.items()}


@pytest.mark.parametrize("layout", MORE)
def test_each_layout_gives_every_pixel_and_time(written, drive, layout):
    pairs, camera = drive
    assert recognise_source(written[layout]) == KINDS.get(layout, "folders")
    source = open_source(written[layout])
    assert len(source) == len(pairs)
    assert source.calibration.baseline_m == pytest.approx(camera.baseline_m, rel=1e-12)
    assert "\n" not in source.description
    assert all(path.is_file() for path in source.files)
    first_s = next(source.frames()).timestamp_s
    for start in (0, 7, FRAMES - 1, FRAMES):
        read = list(source.frames(start))
        assert [pair.index for pair in read] == list(range(start, FRAMES))
        for ours, truth in zip(read, pairs[start:], strict=True):
            # Stamps of today have 0.2 µs in a double.
            assert ours.timestamp_s - first_s == pytest.approx(truth.timestamp_s, abs=1e-6)
            for seen, true in ((ours.left, truth.left), (ours.right, truth.right)):
                # A video has three channels, of a grey image three equal ones.
                channels = seen.reshape(*true.shape, -1)
                np.testing.assert_array_equal(
                    channels, np.broadcast_to(true[:, :, None], channels.shape)
                )


@pytest.mark.parametrize("layout", MORE)
def test_a_pipe_in_place_of_a_file_is_refused_or_left_out(noise, tmp_path, layout):
    """Opening one would wait for ever for what nobody writes."""
    path, good = MORE[layout](noise, CAMERA, tmp_path / "good"), tmp_path / "good"
    files = sorted(file for file in good.rglob("*") if file.is_file())
    seen = [file for file in files if file.suffix == ".png"]
    for file in [*(one for one in files if one not in seen), *seen[:1], *seen[-1:]]:
        drive = tmp_path / "bad"
        shutil.copytree(good, drive)
        pipe = drive / file.relative_to(good)
        pipe.unlink()
        os.mkfifo(pipe)

        def read(drive: Path = drive, pipe: Path = pipe) -> None:
            source = open_source(drive / path.relative_to(good))
            mark_of(source)
            list(source)
            assert pipe not in source.files

        refusal(read)
        shutil.rmtree(drive)


SHORT, LONG, WIDTH_PX, HEIGHT_PX = 50, 100, 320, 240


@pytest.fixture(scope="module")
def long():
    """Shifted noise, which compresses badly and so fills a disk."""
    rng = np.random.default_rng(0)
    wide = rng.integers(0, 256, (HEIGHT_PX, WIDTH_PX + LONG + 8), dtype=np.uint8)
    camera = RectifiedCamera(200.0, 159.5, 119.5, 159.5, 0.2, WIDTH_PX, HEIGHT_PX)
    pairs = [
        StereoPair(wide[:, k : k + WIDTH_PX], wide[:, k + 8 : k + 8 + WIDTH_PX], 0.1 * k, k)
        for k in range(LONG)
    ]
    return pairs, camera


@pytest.mark.parametrize("layout", ["kitti", "two videos", "ros 1", "ros 2", "mcap"])
def test_a_longer_drive_takes_no_more_memory(long, tmp_path, layout):
    pairs, camera = long
    peaks = []
    for count in (SHORT, LONG):
        path = MORE[layout](pairs[:count], camera, tmp_path / str(count))
        tracemalloc.start()
        try:
            assert sum(1 for _ in open_source(path)) == count
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    # Times and names are known of every pair; a recording is read in chunks of a megabyte.
    assert peaks[1] - peaks[0] < 2000 * (LONG - SHORT)
    pair_bytes = 2 * WIDTH_PX * HEIGHT_PX
    assert pair_bytes < peaks[1] < 0.5 * LONG * pair_bytes


def images(folder: Path, side: int) -> list[Path]:
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
def test_every_layout_gives_a_part_of_itself(numbered, tmp_path, layout):
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
    assert part.figures().to_json() == {"frames_left_out": 0}
    if part.stamps_s is not None:
        assert part.stamps_s.tolist() == [pair.timestamp_s for pair in found]
    for side in (0, 1):  # images that are skipped are not read
        for number, image in enumerate(images(tmp_path, side)):
            if number not in CHOSEN:
                image.write_bytes(b"not an image")
    assert [shown(pair)[0] for pair in open_source(path, settings=PART)] == CHOSEN


def test_truth_begins_at_the_first_frame_that_is_chosen(numbered, tmp_path):
    kitti = write_kitti(numbered, CAMERA, tmp_path / "kitti")
    folder = drives.write_folders(numbered, CAMERA, tmp_path / "folders")
    rows = [f"{0.1 * k:.3f} 0 0 {k} 0 0 0 1\n" for k in range(1, 10)]
    (folder / "groundtruth.txt").write_text("".join(rows))
    assert open_source(folder).truth is None
    for path in (kitti, folder):
        truth = open_source(path, settings=PART).truth.trajectory
        np.testing.assert_allclose(truth.positions_m[:, 2], [0, 3, 6], atol=1e-9)
        np.testing.assert_allclose(truth.timestamps_s, [0.2, 0.5, 0.8], atol=1e-9)


@pytest.mark.parametrize("numbers", [range(FRAMES), CHOSEN])
def test_known_poses_are_of_chosen_frames(noise, tmp_path, numbers):
    folder = drives.write_folders(noise[:FRAMES], CAMERA, tmp_path)
    poses = [make_transform(np.eye(3), np.array([0.0, 0.0, float(k)])) for k in numbers]
    known = Trajectory(np.stack(poses), np.arange(len(numbers), dtype=np.float64))
    mapped = map_sequence(open_source(folder, settings=PART), load_config(), known_poses=known)
    assert mapped.trajectory.positions_m[:, 2].tolist() == [0, 3, 6]


@pytest.mark.parametrize("shift", [-2, 1])
@pytest.mark.parametrize("layout", ALL)
def test_every_layout_pairs_each_left_image_with_the_right_one_of_later(
    numbered, tmp_path, layout, shift
):
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
    assert (source.lines(FRAMES), source.left_out) == (kept, 0)
    part = open_source(path, settings=SourceSettings(shift_frames=shift, start=1, stride=3))
    assert [shown(pair)[0] for pair in part] == kept[1::3]
    assert part.shift_of(-2) == shift - 6  # what the audit advises counts what is left out


def test_of_two_rates_the_slower_camera_counts(numbered, tmp_path):
    folder = IN_IMAGES["stamped"](numbered, CAMERA, tmp_path)
    for number, path in enumerate(images(folder, 1)):
        if number % 3:
            path.unlink()
    source = open_source(folder, settings=SourceSettings(shift_frames=1))
    assert [shown(pair) for pair in source] == [(0, 3), (3, 6), (6, 9)]


@pytest.mark.parametrize("layout", ["kitti", "two videos", "mcap"])
@pytest.mark.parametrize(("settings", "message"), [
    *(({"shift_frames": by}, rf"no pair is left .*shift_frames={by}, 11 frames")
      for by in (FRAMES, -FRAMES, 10**9)),
    *(({"start": start, "end": end}, r"no frame is chosen .*frames from 0 to 10")
      for start, end in ((11, None), (4, 4), (5, 3))),
])  # fmt: skip
def test_settings_that_leave_no_pair_are_refused(numbered, tmp_path, layout, settings, message):
    path = ALL[layout](numbered, CAMERA, tmp_path)
    with pytest.raises(ReconError, match=message):
        open_source(path, settings=SourceSettings(**settings))


def test_cameras_take_no_shift():
    settings = SourceSettings(shift_frames=1)
    with (
        pytest.raises(ReconError, match=r"shift_frames: images of cameras are paired as they are"),
        open_camera_source(["0", "1"], CaptureSettings(), settings),
    ):
        pass


def counted(pairs: Pairs) -> Pairs:
    return [replace(p, index=k, timestamp_s=0.1 * k) for k, p in enumerate(pairs)]


@pytest.mark.parametrize("frames", [-1, 1, 2])
def test_the_audit_names_the_shift_of_a_drive(drive, tmp_path, frames):
    pairs, camera = drive
    late = [
        replace(pair, right=pairs[pair.index - frames].right)
        for pair in pairs
        if 0 <= pair.index - frames < len(pairs)
    ]
    folder = drives.write_kitti(counted(late), camera, tmp_path / "late")
    findings = audit_source(open_source(folder), load_config(), quick=True).findings
    (finding,) = (one for one in findings if one.code == "lag")
    assert f"(source.shift_frames={frames})" in finding.text
    shifted = open_source(folder, settings=SourceSettings(shift_frames=frames))
    known = [p for p in pairs if abs(frames) <= p.index < len(pairs) - abs(frames)]
    same = drives.write_kitti(counted(known), camera, tmp_path / "known")
    mapped, expected = (
        map_sequence(source, load_config()).trajectory.positions_m
        for source in (shifted, open_source(same))
    )
    # Their times begin elsewhere, which rounds.
    np.testing.assert_allclose(mapped, expected, atol=1e-6)


@pytest.mark.parametrize("layout", IN_IMAGES)
def test_frames_without_a_partner_are_counted(numbered, tmp_path, layout):
    folder = IN_IMAGES[layout](numbered, CAMERA, tmp_path)
    images(folder, 0)[7].unlink()
    images(folder, 1)[4].unlink()
    source = open_source(folder)
    kept = [0, 1, 2, 3, 5, 6, 8, 9, 10]
    assert [shown(pair) for pair in source] == [(k, k) for k in kept]
    assert (source.left_out, source.figures().to_json()) == (2, {"frames_left_out": 2})
    assert source.warnings() == ["2 images without a partner: left out"]
    assert "1 left and 1 right without a partner left out" in source.description
    # Stamps in microseconds.
    times = source.stamps_s - source.stamps_s[0]
    np.testing.assert_allclose(times, 0.1 * np.array(kept), atol=2e-6)
    if source.truth is not None and source.truth.trajectory is not None:
        assert source.truth.trajectory.positions_m[:, 2].tolist() == kept
    assert (source.lines(FRAMES), source.lines(len(kept))) == (kept, list(range(len(kept))))
    # With a shift a lost image costs its pair and moves no other.
    late = open_source(folder, settings=SourceSettings(shift_frames=1))
    assert [shown(pair) for pair in late] == [(k, k + 1) for k in (0, 1, 2, 4, 5, 6, 8, 9)]
    assert late.left_out == 2
    for path in images(folder, 1)[1:7]:
        path.unlink()
    if layout != "stamped":  # whose names may also be those of a slower camera
        with pytest.raises(SourceError, match=r"most images have no partner|numbers of left"):
            open_source(folder)
