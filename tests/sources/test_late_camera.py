"""One camera late by whole frames: `source.shift_frames` pairs the images that belong together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import ReconError
from recon.core.values import RectifiedCamera, StereoPair
from recon.map.drive.sequence import map_sequence
from recon.rig.audit.audit import audit_source
from recon.rig.cameras import open_camera_source
from recon.rig.capture import CaptureSettings
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from tests.sources import drives
from tests.sources.test_chosen_frames import ALL, CAMERA, FRAMES
from tests.sources.test_stray_frames import LAYOUTS, images


def late(pairs: list[StereoPair], frames: int) -> list[StereoPair]:
    """The right images of so many frames before, as a late camera records them."""
    return [
        replace(pair, right=pairs[pair.index - frames].right)
        for pair in pairs
        if 0 <= pair.index - frames < len(pairs)
    ]


def numbered(pairs: list[StereoPair]) -> list[StereoPair]:
    """The pairs, counted from 0 at time 0."""
    return [replace(p, index=k, timestamp_s=0.1 * k) for k, p in enumerate(pairs)]


@pytest.fixture(scope="module")
def pairs() -> list[StereoPair]:
    """The grey value of both images is ten times the number of the frame."""
    grey = (np.full((32, 64), 10 * index, np.uint8) for index in range(FRAMES))
    return [StereoPair(image, image, 0.1 * k, k) for k, image in enumerate(grey)]


@pytest.fixture(scope="module")
def street() -> tuple[list[StereoPair], RectifiedCamera]:
    return drives.rendered(9, width_px=320, height_px=160, focal_px=190.0)


def shown(pair: StereoPair) -> tuple[int, int]:
    """The numbers of the frames that a pair shows; video codecs change grey values a little."""
    left, right = (round(float(view.mean()) / 10) for view in (pair.left, pair.right))
    return left, right


@pytest.mark.parametrize("shift", [-2, 1])
@pytest.mark.parametrize("layout", ALL)
def test_every_layout_pairs_each_left_image_with_the_right_one_of_later(
    pairs: list[StereoPair], tmp_path: Path, layout: str, shift: int
) -> None:
    path = ALL[layout](pairs, CAMERA, tmp_path)
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


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_lost_image_costs_its_pair_and_moves_no_other(
    pairs: list[StereoPair], tmp_path: Path, layout: str
) -> None:
    folder = LAYOUTS[layout](pairs, CAMERA, tmp_path)
    images(folder, 0)[7].unlink()
    images(folder, 1)[4].unlink()
    source = open_source(folder, settings=SourceSettings(shift_frames=1))
    # The partner of left image 3 is lost.
    assert [shown(pair) for pair in source] == [(k, k + 1) for k in (0, 1, 2, 4, 5, 6, 8, 9)]
    assert source.left_out == 2


def test_of_cameras_with_different_rates_the_frames_of_the_slower_one_count(
    pairs: list[StereoPair], tmp_path: Path
) -> None:
    folder = LAYOUTS["stamped"](pairs, CAMERA, tmp_path)
    for number, path in enumerate(images(folder, 1)):
        if number % 3:
            path.unlink()
    source = open_source(folder, settings=SourceSettings(shift_frames=1))
    assert [shown(pair) for pair in source] == [(0, 3), (3, 6), (6, 9)]


@pytest.mark.parametrize("shift", [FRAMES, -FRAMES, 10**9])
@pytest.mark.parametrize("layout", ["kitti", "euroc", "two videos", "mcap"])
def test_a_shift_that_leaves_no_pair_is_refused(
    pairs: list[StereoPair], tmp_path: Path, layout: str, shift: int
) -> None:
    path = ALL[layout](pairs, CAMERA, tmp_path)
    with pytest.raises(ReconError, match=rf"no pair is left .*shift_frames={shift}, 11 frames"):
        open_source(path, settings=SourceSettings(shift_frames=shift))


def test_cameras_take_no_shift() -> None:
    settings = SourceSettings(shift_frames=1)
    with (
        pytest.raises(ReconError, match=r"shift_frames: images of cameras are paired as they are"),
        open_camera_source(["0", "1"], CaptureSettings(), settings),
    ):
        pass


@pytest.mark.parametrize("frames", [-1, 1, 2])
def test_the_audit_names_the_shift_with_which_a_late_drive_is_mapped_as_if_it_were_not(
    street: tuple[list[StereoPair], RectifiedCamera], tmp_path: Path, frames: int
) -> None:
    drive, camera = street
    folder = drives.write_kitti(numbered(late(drive, frames)), camera, tmp_path / "late")
    (finding,) = (
        one
        for one in audit_source(open_source(folder), load_config(), quick=True).findings
        if one.code == "lag"
    )
    assert f"--set source.shift_frames={frames} " in finding.text
    shifted = open_source(folder, settings=SourceSettings(shift_frames=frames))
    known = [p for p in drive if abs(frames) <= p.index < len(drive) - abs(frames)]
    same = drives.write_kitti(numbered(known), camera, tmp_path / "known")
    mapped, expected = (
        map_sequence(source, load_config()) for source in (shifted, open_source(same))
    )
    # Their times begin elsewhere, which rounds.
    np.testing.assert_allclose(
        mapped.trajectory.positions_m, expected.trajectory.positions_m, atol=1e-6
    )


def test_the_advice_counts_what_is_shifted_already_and_frames_that_are_left_out(
    pairs: list[StereoPair], tmp_path: Path
) -> None:
    folder = drives.write_kitti(pairs, CAMERA, tmp_path)
    source = open_source(folder, settings=SourceSettings(shift_frames=1, stride=2))
    assert source.shift_of(-2) == -3
