"""A drive that comes back is recognised; a street that only looks the same is not."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np

from recon.core.geometry import se3
from recon.places import places
from recon.places.detector import LoopDetector
from tests.places.conftest import LAP, PERIOD, KeyframeMemory, drifted

FIRST = range(7)
AGAIN = range(LAP, LAP + 7)
BLIND = {"SHARE": 1.0, "TURN_DEG": 5.0}
"""As if odometry knew next to nothing."""


def test_a_drive_around_a_block_is_recognised_at_its_start(block):
    detector, _ = block.detect([*FIRST, *AGAIN], block.truth)

    loops = detector.agreeing()
    assert len(loops) >= 5
    for loop in loops:
        off = se3.invert(block.drive.motion(loop.first, loop.last)) @ loop.T_first_last
        assert np.linalg.norm(off[:3, 3]) < 0.2


def test_a_drive_is_recognised_in_spite_of_drift(block):
    path = drifted(block.truth, share=0.01, turn_deg_per_m=0.015)
    detector, _ = block.detect([*FIRST, *AGAIN], path)

    assert len(detector.agreeing()) >= 5


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
    assert sum(detector.refused.values()) > 0


def test_a_single_loop_is_not_believed(block):
    detector, _ = block.detect([*FIRST, LAP + 3], block.truth)

    assert len(detector.loops) == 1
    assert detector.agreeing() == []


def test_frames_without_a_measured_pose_are_no_keyframes(block):
    detector, _ = block.detect([0, 2, 4], block.truth, lost=(2,))

    assert len(detector) == 2


def test_standing_still_makes_no_keyframes(block):
    pair, disparity = block.frame(0)
    detector = LoopDetector(KeyframeMemory())
    for k in range(5):
        detector.add(k, pair, disparity, np.eye(4), path_m=0.0)

    assert len(detector) == 1


def test_a_restored_detector_goes_on_as_if_it_had_never_stopped(block):
    frames = [*FIRST, *AGAIN]
    whole, path_m = block.detect(frames, block.truth)
    begun, _ = block.detect(frames[:9], block.truth)
    resumed = LoopDetector(begun._store)
    for stored in begun._store:
        resumed.restore(stored)
    for k in frames[9:]:
        pose = block.truth.T_world_camera[k]
        resumed.add(k, *block.frame(k), pose, path_m=path_m[k])

    def key(loop):
        return (loop.first, loop.last, loop.T_first_last.tobytes())

    assert [key(loop) for loop in resumed.loops] == [key(loop) for loop in whole.loops]
