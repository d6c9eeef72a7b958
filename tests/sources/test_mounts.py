"""Where the camera is on a robot, by static transforms, whole and broken."""

import numpy as np
import pytest

from recon.core.errors import FormatError
from recon.core.geometry.se3 import (
    exp_so3,
    invert,
    make_transform,
    quaternion_from_rotation,
)
from recon.core.values import CameraIntrinsics, StereoCalibration
from recon.io.ros.contents import BagPose
from recon.map.drive.drive_odometry import mount_of
from recon.sources.bag import find_mount, static_transform
from recon.sources.live import LiveSource
from recon.sources.source import Mount, SourcePart, StereoSource
from recon.stereo.rectify.rectifier import RectificationSettings

A = make_transform(exp_so3(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
B = make_transform(exp_so3(np.array([-0.4, 0.1, 0.2])), np.array([-1.0, 0.5, 0.2]))


def edge(parent: str, child: str, T: np.ndarray = A, **parts: np.ndarray) -> BagPose:
    xyzw = quaternion_from_rotation(T[:3, :3])
    return BagPose(0, 0, parent, child, T[:3, 3].copy(), xyzw)._replace(**parts)


def test_transforms_are_joined_both_ways_along_the_tree():
    tree = [edge("base", "mast", A), edge("mast", "cam", B), edge("base", "wheel", B)]
    for edges in (tree, tree[::-1], iter(tree)):
        T = static_transform(edges, "base", "cam")
        np.testing.assert_allclose(T, A @ B, atol=1e-12)
    np.testing.assert_allclose(static_transform(tree, "cam", "wheel"), invert(A @ B) @ B, atol=1e-9)
    for start, goal in (("base", "nowhere"), ("nowhere", "base"), ("", "cam"), ("base", "")):
        assert static_transform(tree, start, goal) is None


@pytest.mark.parametrize(
    ("edges", "expected"),
    [
        # A loop, in which the way of fewest steps counts; a frame that is its own parent.
        ([edge("a", "b"), edge("b", "c"), edge("c", "a", B)], invert(B)),
        ([edge("a", "a", B), edge("a", "c", A), edge("c", "c", B)], A),
        # Two parents of one frame, of which either leads there.
        ([edge("a", "x"), edge("c", "x", B)], A @ invert(B)),
        # Who said it last is right, also the other way round.
        ([edge("a", "c", B), edge("a", "c", A)], A),
        ([edge("a", "c", B), edge("c", "a", A)], invert(A)),
        ([edge("a", "c", A)], A),
        # What is broken elsewhere does not matter.
        ([edge("a", "c"), edge("a", "x", xyzw=np.zeros(4)), edge("x", "c")], A),
        ([edge("a", "c"), edge("a", "c", xyzw=np.full(4, np.nan))], A),
    ],
)
def test_a_tree_that_is_none_still_leads_from_frame_to_frame(edges, expected):
    np.testing.assert_allclose(static_transform(edges, "/a", "c"), expected, atol=1e-12)


@pytest.mark.parametrize(
    "broken",
    [
        {"xyzw": np.zeros(4)},
        {"xyzw": np.array([0, 0, 0, 1.1])},
        {"xyzw": np.array([np.nan, 0, 0, 1])},
        {"xyz_m": np.array([0, np.inf, 0])},
    ],
)
def test_a_transform_that_is_no_motion_is_one_line(broken):
    edges = [edge("base_link", "mast", A), edge("mast", "cam", **broken)]
    with pytest.raises(FormatError, match=r"no motion .*mast to cam") as caught:
        find_mount(edges, "cam")
    assert "\n" not in str(caught.value)


def test_the_base_on_the_ground_is_preferred_and_says_the_height():
    link, foot = edge("base_link", "cam", A), edge("base_footprint", "base_link", B)
    found = find_mount([link, foot], "/cam")
    assert (found.base, found.camera) == ("base_footprint", "cam")
    np.testing.assert_allclose(found.T_base_camera, B @ A, atol=1e-12)
    assert found.camera_height_m == pytest.approx((B @ A)[2, 3])
    found = find_mount([link, edge("base_footprint", "cart")], "cam")
    assert (found.base, found.camera_height_m) == ("base_link", None)
    # Two robots in one recording: that which carries the camera.
    found = find_mount([edge("a/base_link", "a/cam"), edge("b/base_link", "b/cam", B)], "b/cam")
    assert found.base == "b/base_link"
    np.testing.assert_allclose(found.T_base_camera, B, atol=1e-12)
    # Below its own footprint is no camera; nor is a base that images only name.
    assert (
        Mount(make_transform(np.eye(3), np.array([0, 0, -1.0])), "base_footprint").camera_height_m
        is None
    )
    for edges, camera in (([], "cam"), ([foot], "cam"), ([edge("base_link", "x")], "base_link")):
        assert find_mount(edges, camera) is None


class Raw(StereoSource):
    """Two raw cameras, of which the left one is turned against the line between them."""

    matrix = np.array([[200.0, 0, 100], [0, 200, 60], [0, 0, 1]])
    left = CameraIntrinsics(matrix, np.zeros(0), 200, 120)
    calibration = StereoCalibration(
        left,
        left,
        make_transform(exp_so3(np.array([0.01, 0.05, 0.02])), np.array([-0.2, 0.01, 0.02])),
    )

    def __len__(self):
        return 3

    def frames(self, start=0):
        return iter(())

    def read_mount(self):
        return Mount(A, "base_link", "cam")


def test_the_mount_is_of_the_rectified_view_of_a_raw_camera():
    source = Raw()
    found, doubts = mount_of(source, RectificationSettings())
    assert doubts == []
    # By definition its x axis points at the other camera, and it is where the raw one is.
    right_m = invert(source.calibration.T_right_left)[:3, 3]
    along = A[:3, :3] @ right_m / np.linalg.norm(right_m)
    np.testing.assert_allclose(found.T_base_camera[:3, 0], along, atol=1e-9)
    np.testing.assert_allclose(found.T_base_camera[:3, 3], A[:3, 3], atol=1e-12)
    assert np.degrees(np.arccos(along @ A[:3, 0])) > 1
    source.read_mount = lambda: find_mount([edge("base_link", "cam", xyzw=np.zeros(4))], "cam")
    found, (said,) = mount_of(source, RectificationSettings())
    assert found is None
    assert said.startswith("transforms of the robot not used: a static transform is no motion")
    for other in (SourcePart(Raw(), 0, 2), LiveSource(Raw())):
        np.testing.assert_array_equal(other.read_mount().T_base_camera, A)


def test_what_the_base_hangs_from_is_what_odometry_moves():
    below = [edge("base_link", "base_footprint", A), edge("base_link", "cam", B)]
    found = find_mount(below, "cam")
    assert found is not None
    assert (found.base, found.root) == ("base_footprint", "base_link")
    np.testing.assert_allclose(found.T_base_root, invert(A), atol=1e-12)
    above = [edge("base_footprint", "base_link", A), edge("base_link", "cam", B)]
    found = find_mount(above, "cam")
    assert found is not None
    assert (found.base, found.root) == ("base_footprint", "")
    circle = [*above, edge("cam", "base_footprint", A)]
    assert find_mount(circle, "cam") is not None
