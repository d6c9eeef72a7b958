"""The keyframes of all drives of a map are views in its world."""

from __future__ import annotations

import numpy as np
import pytest

from recon.core.geometry import se3
from recon.core.values import RectifiedCamera
from recon.map.store.map_file import MapViews
from recon.map.store.record_values import Link
from recon.map.store.session import SessionInfo
from recon.map.verbs import Map
from recon.odometry.protocol import OdometryHealth
from recon.places.detector import StoredKeyframe
from recon.places.keyframe import Keyframe
from recon.places.loop import Loop

CAMERAS = [RectifiedCamera(100.0 + n, 9.0, 5.0, 9.5, 0.5, 20, 12) for n in range(3)]
T_MAP_WORLD = [
    se3.make_transform(se3.exp_so3(np.array([0.1, 0.2 * n, 0.0])), np.array([n, 0.0, 1.0]))
    for n in range(3)
]
FRAMES = 6
KEYFRAMES = (0, 2, 5)


def _pose(frame: int) -> np.ndarray:
    return se3.make_transform(np.eye(3), np.array([0.0, 0.0, 1.5 * frame]))


def _keyframe(frame: int) -> Keyframe:
    blank = np.zeros((0, 3), np.float32), np.zeros((0, 32), np.uint8), np.zeros((2, 3), np.float32)
    return Keyframe(frame, *blank)


@pytest.fixture
def map_() -> Map:
    """Three drives with other cameras and axes; the last one has no keyframes."""
    made = Map.temporary()
    for n in range(3):
        session = made.begin(SessionInfo(f"drive {n}"))
        session.set_axes(T_MAP_WORLD[n], CAMERAS[n])
        for frame in range(FRAMES):
            session.add_frame(_pose(frame), 0.1 * frame, OdometryHealth())
        for frame in KEYFRAMES if n < 2 else ():
            session.keyframes.put(StoredKeyframe(_keyframe(frame), _pose(frame), 1.5 * frame))
    loop = Loop(0, 0, np.eye(4), np.eye(6), 50, 0.9)
    made.set_links([Link((0, n), loop) for n in (1, 2)], [0, 1, 2])
    return made


def test_views_are_the_keyframes_of_all_linked_drives(map_):
    views = MapViews(map_)

    assert [(view.session, view.keyframe.frame) for view in views] == [
        (n, frame) for n in (0, 1) for frame in KEYFRAMES
    ]
    assert [view.camera for view in views[2:4]] == CAMERAS[:2]


def test_views_are_in_the_world_of_the_first_drive(map_):
    first, other = MapViews(map_)[1], MapViews(map_)[4]

    assert first.T_world_camera == pytest.approx(_pose(2))
    T_map_camera = T_MAP_WORLD[1] @ _pose(2)
    assert T_MAP_WORLD[0] @ other.T_world_camera == pytest.approx(T_map_camera)


def test_views_follow_the_path_after_loop_closure(map_):
    moved = np.stack([se3.make_transform(np.eye(3), np.full(3, k)) for k in range(FRAMES)])
    map_.session(0).set_loops({"closed": [], "refused": [], "T_world_camera": moved})

    assert MapViews(map_)[1].T_world_camera == pytest.approx(moved[2])


def test_some_drives_may_be_left_out(map_):
    assert [view.session for view in MapViews(map_, [1])] == [1, 1, 1]
    map_.set_links([], [1])
    assert [view.session for view in MapViews(map_)] == [1, 1, 1]


def test_what_follows_a_lost_pose_is_not_to_be_recognised_among_several_drives():
    map_ = Map.temporary()
    for n in range(2):
        session = map_.begin(SessionInfo())
        session.set_axes(T_MAP_WORLD[n], CAMERAS[n])
        for frame in range(FRAMES):
            session.add_frame(_pose(frame), 0.1 * frame, OdometryHealth(ok=(n, frame) != (1, 3)))
        for frame in KEYFRAMES:
            session.keyframes.put(StoredKeyframe(_keyframe(frame), _pose(frame), 1.5 * frame))
    map_.set_links([Link((0, 1), Loop(0, 0, np.eye(4), np.eye(6), 50, 0.9))], [0, 1])

    seen = [(view.session, view.keyframe.frame) for view in MapViews(map_)]

    assert seen == [(0, 0), (0, 2), (0, 5), (1, 0), (1, 2)]
    assert [view.keyframe.frame for view in MapViews(map_, [1])] == [0, 2, 5]
