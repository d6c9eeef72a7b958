"""Places of a map are recognised in another drive, and alike ones contradict each other."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry import se3
from recon.core.values import Disparity, RectifiedCamera, RectifiedPair
from recon.places.detector import KnownPlaces, KnownView
from recon.places.keyframe import make_keyframe
from recon.places.loop import agreeing_loops
from tests.places.conftest import LAP, PERIOD

AHEAD = RectifiedCamera(180.0, 159.5, 59.5, 159.5, 0.54, 320, 120)
CUT = RectifiedCamera(180.0, 135.5, 55.5, 135.5, 0.54, 280, 108)


def _known(filmed, frames) -> KnownPlaces:
    poses = filmed.truth.T_world_camera
    return KnownPlaces([KnownView(filmed.keyframe(k), AHEAD, poses[k]) for k in frames])


@pytest.fixture(scope="module")
def known(block) -> KnownPlaces:
    return _known(block, [0, 2, 4, 6, 60, 62, 100])


def _agreeing(known, loops, poses):
    firsts = {number: (T, 0.0) for number, T in enumerate(known.T_world_camera)}
    lasts = {loop.last: (poses[loop.last], 1.5 * loop.last) for loop in loops}
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


def test_a_place_that_is_not_in_the_map_is_not_found(known, block):
    found = known.recognise(block.keyframe(140), AHEAD)

    assert found.loops == ()
    assert found.refused


def test_only_some_views_may_be_asked_for(known, block):
    there = np.zeros(len(known), bool)
    there[4:] = True

    assert known.recognise(block.keyframe(LAP + 3), AHEAD, there).loops == ()


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


def test_a_map_without_keyframes_recognises_nothing(block):
    empty = KnownPlaces([])

    assert len(empty) == 0
    assert empty.recognise(block.keyframe(0), AHEAD).loops == ()
    assert empty.near(np.eye(4), 3) == []
