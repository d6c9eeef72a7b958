"""A place that is seen again is recognised, and one that only looks the same is not."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from recon.core.geometry import se3
from recon.core.values import Disparity, RectifiedCamera, RectifiedPair
from recon.places import places
from recon.places.detector import KnownPlaces, KnownView, LoopDetector
from recon.places.keyframe import make_keyframe
from recon.places.places import agreeing_loops
from tests.places.conftest import LAP, PERIOD, KeyframeMemory, drifted

AHEAD = RectifiedCamera(180.0, 159.5, 59.5, 159.5, 0.54, 320, 120)
CUT = RectifiedCamera(180.0, 135.5, 55.5, 135.5, 0.54, 280, 108)

FIRST = range(7)
AGAIN = range(LAP, LAP + 7)
BLIND = {"SHARE": 1.0, "TURN_DEG": 5.0}
"""As if odometry knew next to nothing."""


@pytest.mark.parametrize("drifts", [False, True])
def test_a_drive_around_a_block_is_recognised_at_its_start(block, drifts):
    path = drifted(block.truth, ratio=0.01, turn_deg_per_m=0.015) if drifts else block.truth
    loops = block.detect([*FIRST, *AGAIN], path)[0].agreeing()
    assert len(loops) >= 5
    for loop in loops:
        off = se3.invert(block.motion(loop.first, loop.last)) @ loop.T_first_last
        assert np.linalg.norm(off[:3, 3]) < 0.2


def test_behind_a_break_a_place_is_recognised_wherever_odometry_begins_anew(block):
    away = se3.make_transform(np.eye(3), np.array([500.0, 0.0, 0.0]))
    poses = away @ block.truth.T_world_camera
    poses[: AGAIN[0]] = block.truth.T_world_camera[: AGAIN[0]]
    path = replace(block.truth, T_world_camera=poses)
    loops = block.detect([*FIRST, *AGAIN], path, dict.fromkeys(AGAIN, 1))[0].agreeing()
    assert len({loop.last for loop in loops}) >= 5
    offs = [se3.invert(block.motion(one.first, one.last)) @ one.T_first_last for one in loops]
    assert np.quantile([np.linalg.norm(off[:3, 3]) for off in offs], 0.95) < 0.2


def test_a_camera_that_goes_back_leaves_keyframes_as_one_that_goes_on(block):
    ways = range(8), range(7, -1, -1)
    on, back = (len(block.detect(frames, block.truth)[0]) for frames in ways)
    assert min(on, back) >= 4


def test_a_street_that_looks_the_same_is_refused(alike):
    """Images and shapes match, but odometry cannot be wrong by a whole period."""
    frames = [*range(5), *range(PERIOD, PERIOD + 5)]
    detector, _ = alike.detect(frames, alike.truth)
    assert detector.loops == []
    # The trap is a real one: who does not ask odometry falls into it.
    with patch.multiple(places, **BLIND):
        deceived, _ = alike.detect(frames, alike.truth)
        assert len(deceived.agreeing()) >= 3


def test_places_that_are_not_the_same_are_refused_by_geometry_alone(block):
    with patch.multiple(places, **BLIND):
        detector, _ = block.detect([0, 2, 4, 60, 62, 100, 102], block.truth)
    assert detector.loops == []
    assert set(detector.refused) == {"no common motion"}


def test_a_single_loop_is_not_believed(block):
    detector, _ = block.detect([*FIRST, LAP + 3], block.truth)
    assert {loop.last for loop in detector.loops} == {LAP + 3}
    assert detector.agreeing() == []


def test_frames_without_a_measured_pose_or_motion_are_no_keyframes(block):
    assert len(block.detect([0, 4, 8], block.truth, {4: -1})[0]) == 2
    detector = LoopDetector(KeyframeMemory(), AHEAD)
    for k in range(5):
        detector.add(k, *block.frame(0), np.eye(4), path_m=0.0)
    assert len(detector) == 1


def test_a_restored_detector_goes_on_as_if_it_had_never_stopped(block):
    frames = [*FIRST, *AGAIN]
    whole, path_m = block.detect(frames, block.truth)
    begun, _ = block.detect(frames[:9], block.truth)
    resumed = LoopDetector(begun._store, AHEAD)
    for stored in begun._store:
        resumed.restore(stored)
    for k in frames[9:]:
        pose = block.truth.T_world_camera[k]
        resumed.add(k, *block.frame(k), pose, path_m=path_m[k])

    def key(loop):
        return (loop.first, loop.last, loop.T_first_last.tobytes())

    assert [key(loop) for loop in resumed.loops] == [key(loop) for loop in whole.loops]


def _known(filmed, frames) -> KnownPlaces:
    poses = filmed.truth.T_world_camera
    return KnownPlaces([KnownView(filmed.keyframe(k), AHEAD, poses[k]) for k in frames])


@pytest.fixture(scope="module")
def known(block) -> KnownPlaces:
    return _known(block, [0, 2, 4, 6, 60, 62, 100])


def _agreeing(known, loops, poses):
    firsts = {number: (T, 0.0, 0) for number, T in enumerate(known.T_world_camera)}
    lasts = {loop.last: (poses[loop.last], 1.5 * loop.last, 0) for loop in loops}
    return agreeing_loops(loops, firsts, lasts)


def _off_m(known, block, loop) -> float:
    T_found = known.T_world_camera[loop.first] @ loop.T_first_last
    off = se3.invert(block.truth.T_world_camera[loop.last]) @ T_found
    return float(np.linalg.norm(off[:3, 3]))


def test_a_later_drive_is_found_where_it_is(known, block):
    loops = [
        loop
        for k in range(LAP + 1, LAP + 6)
        for loop in known.recognise(block.keyframe(k), AHEAD).loops
    ]
    assert len(_agreeing(known, loops, block.truth.T_world_camera)) >= 3
    assert max(_off_m(known, block, loop) for loop in loops) < 0.2


def test_a_place_that_is_not_in_the_map_or_not_asked_for_is_not_found(known, block):
    found = known.recognise(block.keyframe(140), AHEAD)
    assert found.loops == ()
    assert set(found.refused) == {"no common motion"}
    asked = np.arange(len(known)) >= 4
    assert known.recognise(block.keyframe(LAP + 3), AHEAD, asked).loops == ()
    empty = KnownPlaces([])
    assert len(empty) == 0
    assert empty.recognise(block.keyframe(0), AHEAD).loops == ()
    assert empty.near(np.eye(4), 3) == []


def test_another_camera_is_found_too(known, block):
    """One that sees a part of the image, so that its principal point is elsewhere."""
    pair, disparity = block.frame(LAP + 3)
    part = np.s_[4:112, 24:304]
    images = (np.ascontiguousarray(image[part]) for image in (pair.left, pair.right))
    seen = (disparity.values, disparity.confidence, disparity.sigma_px, disparity.reason)
    cut = Disparity(*(np.ascontiguousarray(array[part]) for array in seen))
    keyframe = make_keyframe(LAP + 3, RectifiedPair(*images, CUT), cut)
    loops = [found for n in range(4) if (found := known.compare(n, keyframe, CUT).loop)]
    assert len(loops) >= 3
    assert np.median([_off_m(known, block, loop) for loop in loops]) < 0.3


def test_places_that_look_alike_are_both_found_and_neither_is_believed(alike):
    known = _known(alike, [0, 2, 4, PERIOD, PERIOD + 2, PERIOD + 4])
    loops = [loop for k in (0, 2, 4) for loop in known.recognise(alike.keyframe(k), AHEAD).loops]
    assert len(loops) > 3
    assert _agreeing(known, loops, alike.truth.T_world_camera) == []


def test_the_nearest_views_in_the_same_direction_come_first(known, block):
    pose = block.truth.T_world_camera[4]
    assert known.near(pose, 2)[0] == 2
    assert len(known.near(pose, 2)) == 2
    backwards = pose @ se3.make_transform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    assert known.near(backwards, 2) == []
