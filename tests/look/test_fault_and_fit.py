"""What exact tracks of a drive show of a turned right camera and of lenses that bend."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from recon.core.geometry.se3 import apply, exp_so3, invert, make_transform
from recon.core.values import CameraIntrinsics, RectifiedCamera, StereoCalibration
from recon.core.values.camera import project
from recon.look.fault import LENS, NAMES, RigFault, active, may_bend, shrink, without_fault
from recon.look.fit import FittedFault, fit_fault
from recon.look.rig import compare_rigs
from recon.look.tracks import StereoTracks, turns
from recon.odometry.pose import TrackWindow, adjust
from recon.stereo.rectify.rectifier import RectificationSettings, turns_of

CAMERA = RectifiedCamera(700.0, 600.0, 180.0, 610.0, 0.5, 1200, 370)
FAULT = RigFault(CAMERA)
ALL = np.ones(len(NAMES), np.bool_)
NONE = np.zeros(len(NAMES))
SETTINGS = RectificationSettings()
NOISE_PX = 0.1
FRAMES, POINTS, WINDOWS = 6, 150, 12


def fault(**parameters: float) -> np.ndarray:
    values = NONE.copy()
    values[[NAMES.index(name) for name in parameters]] = list(parameters.values())
    return values


TURN = fault(pitch=1e-3, yaw=7e-4, roll=-2e-3, zoom=-1e-3)
LENSES = fault(
    left_k1=8e-3, left_k2=-3e-3, left_p1=-1e-3, left_s1=2e-3, left_s3=-1e-3,
    right_k1=5e-3, right_k2=-2e-3, right_p2=1e-3, right_s1=-3e-3, right_s4=1e-4,
)  # fmt: skip


def in_opencv(terms: np.ndarray) -> np.ndarray:
    k1, k2, k3, p1, p2, s1, s2, s3, s4 = terms
    return np.array([k1, k2, p1, p2, k3, 0, 0, 0, s1, s2, s3, s4])


def seen(xyz: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points (N, 3) are in both images of a rig with a fault, as OpenCV projects them."""
    turn, left, right = values[:4], values[4:13], values[13:]
    K = CAMERA.right_matrix.copy()
    K[[0, 1], [0, 1]] /= 1.0 + turn[3]
    there = (xyz - [CAMERA.baseline_m, 0.0, 0.0]) @ exp_so3(-turn[:3]).T
    none = np.zeros(3)
    return (
        cv2.projectPoints(xyz, none, none, CAMERA.matrix, in_opencv(left))[0][:, 0],
        cv2.projectPoints(there, none, none, K, in_opencv(right))[0][:, 0],
    )


def step(frames: float) -> np.ndarray:
    """How a camera moves on in a curve."""
    turn = exp_so3(np.array([0.0, 0.01 * frames, 0.0]))
    return make_transform(turn, np.array([0.005 * frames**2, 0.0, frames]))


def tracks(
    values: np.ndarray, seed: int, late: float = 0.0, nods: np.ndarray | None = None
) -> StereoTracks:
    """Points on a street, seen from six poses by a rig with a fault, the right image late."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(6.0, 60.0, POINTS)
    aside, up = rng.uniform([[-0.7], [-0.2]], [[0.7], [0.2]], (2, POINTS)) * depth
    xyz = np.column_stack([aside, up, depth])
    poses = np.stack([np.linalg.matrix_power(step(1.0), k) for k in range(FRAMES)])
    poses[:, :3, :3] = poses[:, :3, :3] @ (np.eye(3) if nods is None else nods)
    uvd, right_uv = (np.full((FRAMES, POINTS, size), np.nan) for size in (3, 2))
    for k, T in enumerate(poses):
        left, _ = seen(apply(invert(T), xyz), values)
        _, right = seen(apply(invert(T @ step(late)), xyz), values)
        left, right = (at + rng.normal(0.0, NOISE_PX, at.shape) for at in (left, right))
        inside = ((left > 0) & (left < [CAMERA.width_px, CAMERA.height_px])).all(axis=1)
        near = apply(invert(T), xyz)
        inside &= np.abs(near[:, 0]) < near[:, 2]  # a lens may fold what is outside into the image
        uvd[k, inside] = np.column_stack([left, left[:, 0] - right[:, 0]])[inside]
        right_uv[k, inside] = right[inside]
    start = xyz + rng.normal(0.0, 0.02, xyz.shape) * depth[:, None] * [0, 0, 1]
    return StereoTracks(TrackWindow(poses, uvd, start), right_uv)


def fitted(values: np.ndarray, first: int = 0, shown: np.ndarray = ALL) -> FittedFault:
    return fit_fault([tracks(values, first + k) for k in range(WINDOWS)], FAULT, shown)


V, U = np.mgrid[20:350:8j, 150:1050:12j]
RAYS = np.stack([(U - CAMERA.cx_px) / 700, (V - CAMERA.cy_px) / 700, np.ones(U.shape)], -1)
XYZ = 25.0 * RAYS.reshape(-1, 3)


def off_px(values: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Rows and disparities (N, 2) that a rig is off by when a fault was found in it."""
    places = FAULT.correct(*seen(XYZ, values), found)
    off = places.left_uv - places.right_uv
    return np.column_stack([off[:, 1], off[:, 0] - project(XYZ, CAMERA)[2]])


def rms(off: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(off**2, axis=0))


@pytest.mark.parametrize("values", [fault(yaw=1e-4), TURN, LENSES, TURN + LENSES])
def test_places_are_where_a_rig_without_the_fault_sees_them(values):
    assert rms(off_px(values, NONE)).max() > 0.05
    assert np.abs(off_px(values, values)).max() < 0.01


def test_places_follow_the_fault_as_its_derivatives_say():
    rng, step = np.random.default_rng(0), 1e-6
    left, right = rng.uniform(0, [CAMERA.width_px, CAMERA.height_px], (2, 50, 2))
    at = FAULT.correct(left, right, NONE)
    np.testing.assert_allclose(at.left_uv, left, atol=1e-9)
    np.testing.assert_allclose(at.right_uv, right, atol=1e-9)
    for k, one in enumerate(step * np.eye(len(NAMES))):
        ahead, behind = FAULT.correct(left, right, one), FAULT.correct(left, right, -one)
        for there, back, derivative in (
            (ahead.left_uv, behind.left_uv, at.by_left),
            (ahead.right_uv, behind.right_uv, at.by_right),
        ):
            # Of hundreds of pixels per radian.
            np.testing.assert_allclose((there - back) / (2 * step), derivative[..., k], atol=1e-2)


@cache
def raw_rig() -> StereoCalibration:
    """A rig as it comes from a calibration: lenses with distortion, cameras a little askew."""
    K = np.array([[400.0, 0.0, 318.0], [0.0, 401.0, 242.0], [0.0, 0.0, 1.0]])
    lenses = (
        CameraIntrinsics(K, np.array([-0.1, 0.02, 1e-3, -5e-4, 1e-3]), 640, 480),
        CameraIntrinsics(K + np.diag([3.0, 3.0, 0.0]), np.array([-0.11, 0.03, 0, 1e-3]), 640, 480),
    )
    R = exp_so3(np.array([0.01, -0.02, 0.015]))
    return StereoCalibration(*lenses, make_transform(R, R @ np.array([-0.2, 0.004, -0.003])))


@pytest.mark.parametrize("rig", [CAMERA, raw_rig()], ids=["rectified", "raw"])
@pytest.mark.parametrize(
    "values", [fault(yaw=2e-3), fault(pitch=2e-3, roll=-2e-3), LENSES, LENSES + TURN]
)
def test_the_calibration_without_a_fault_sees_what_is_left_of_it(rig, values):
    turns, depth_m = turns_of(rig, SETTINGS), 10.0
    camera = turns.camera
    refined = without_fault(rig, turns, values)
    assert refined.baseline_m == pytest.approx(camera.baseline_m, rel=1e-9)
    change = compare_rigs(rig, refined, depth_m, SETTINGS)
    rows, columns = change.off_px.shape
    v, u = np.mgrid[0 : camera.height_px - 1 : rows * 1j, 0 : camera.width_px - 1 : columns * 1j]
    uv = np.stack([u, v], axis=-1)
    disparity_px = camera.focal_px * camera.baseline_m / depth_m
    right_uv = uv - [disparity_px - camera.doffs_px, 0.0]
    places = RigFault(camera).correct(uv, right_uv, values)
    off = right_uv - uv + places.left_uv - places.right_uv
    both = np.stack([off[..., 0], places.left_uv[..., 1] - places.right_uv[..., 1]])
    found = np.stack([-change.off_px, change.epipolar_error_px])
    shown = np.isfinite(found)
    assert shown.mean() > 0.9
    assert rms(both[shown]) > 0.2
    # Both views turn by half of what the right camera does: second order, at the borders.
    assert rms((found - both)[shown]) < 0.04 * rms(both[shown])


@pytest.mark.parametrize(
    "values", [fault(pitch=2e-3), fault(yaw=1e-3), fault(zoom=2e-3), TURN],
    ids=["pitch", "yaw", "zoom", "all"],
)  # fmt: skip
def test_a_turn_of_the_right_camera_is_recovered(values):
    found = fitted(values)
    assert rms(off_px(values, found.values)).max() < 0.1 * rms(off_px(values, NONE)).max()
    # Where lenses cannot bend, the turn is all there is: 5e-5 rad are 0.035 px.
    turned = fitted(values, shown=np.arange(len(NAMES)) < 4)
    np.testing.assert_allclose(turned.values, values, atol=5e-5)
    assert not turned.covariance[4:].any()


def test_rows_meet_with_the_lenses_that_are_found_and_nothing_is_invented_by_noise():
    found = fitted(LENSES)
    before, after = rms(off_px(LENSES, NONE)), rms(off_px(LENSES, found.values))
    assert (before > [0.35, 0.45]).all()
    assert (after < [0.05, 0.15]).all()
    assert found.windows == WINDOWS
    assert 1.0 <= found.scatter < 2.0
    drives = [fitted(NONE, 100 * n) for n in range(3)]
    assert all(abs(drive.time_offset) < 0.01 for drive in drives)
    assert max(rms(off_px(NONE, drive.values)).max() for drive in drives) < 0.05
    assert all((np.linalg.eigvalsh(drive.covariance) > 0).all() for drive in drives)


def test_what_an_earlier_drive_knew_counts_as_far_as_nothing_contradicts_it():
    first, alone = fitted(TURN), fitted(NONE, 500)
    windows = [tracks(NONE, 500 + k) for k in range(WINDOWS)]
    both = fit_fault(windows, FAULT, ALL, first)
    ratios = np.sqrt(np.diag(both.covariance) / np.diag(alone.covariance))
    # What features that lie alike err by does not average out.
    assert 0.6 < np.median(ratios) < 1.0
    assert rms(off_px(NONE, both.values)).max() < 0.05
    moved, turned = fault(yaw=2e-3), [tracks(fault(yaw=2e-3), k) for k in range(WINDOWS)]
    found = fit_fault(turned, FAULT, ALL, first)
    assert rms(off_px(moved, found.values)).max() < 0.1 * rms(off_px(moved, NONE)).max()


@pytest.mark.parametrize(("late", "values"), [(0.2, NONE), (-0.4, TURN)], ids=["alone", "turned"])
def test_late_right_images_are_told_apart_from_a_turned_camera(late: float, values: np.ndarray):
    found = fit_fault([tracks(values, k, late) for k in range(WINDOWS)], FAULT, ALL)
    assert found.time_offset == pytest.approx(late, abs=0.1 * abs(late))
    assert found.time_offset_sigma < 0.02
    assert rms(off_px(values, found.values)).max() < 0.1


@pytest.mark.slow
def test_intervals_hold_of_40_rigs_with_lenses_three_times_worse_than_expected():
    rng, ratios, sigmas = np.random.default_rng(0), [], 3.0 * FAULT.sigmas
    sigmas[:4] *= 0.1
    for number in range(40):
        values = sigmas * rng.normal(size=len(NAMES))
        found = fitted(values, 100 * number)
        ratios.append(off_px(values, found.values)[:, 1] / np.sqrt(off_squares(found)))
    assert np.mean(np.abs(ratios) <= 1.96, axis=0).min() >= 0.9
    # Noise is a third of what features are expected to have, and these do not err alike.
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 1.0


def test_directions_that_a_drive_shows_well_stay_and_others_become_zero():
    sigmas = np.array([1.0, 2.0, 1.0, 1.0, 1.0])
    H = np.diag([1e6, 1e6, 1.0, 100.0, 0.0])
    values = np.array([0.5, -1.0, 0.4, 0.3, 0.0])
    found, *_ = shrink(values, H, sigmas)
    np.testing.assert_allclose(found[:2], values[:2], rtol=1e-4)
    # 0.8 of its standard deviations, and 3.03 of them.
    assert found[2] == found[4] == 0.0
    assert found[3] == pytest.approx(0.3 * (1 - 1 / 3.03**2), rel=1e-6)
    assert not shrink(np.zeros(5), H, sigmas)[0].any()
    # Two parameters of which only the sum is known share what is shown of it.
    both, *_ = shrink(np.array([0.2, 0.2]), 1e6 * np.ones((2, 2)), np.ones(2))
    np.testing.assert_allclose(both, 0.2, rtol=1e-4)


def test_what_is_left_out_and_lenses_worse_than_expected_are_part_of_the_error():
    values, H = np.array([0.5, 0.4, 0.3, 0.2, 3.0, 0.0]), np.diag([1e6, 1.0, 100.0, 0.0, 1e4, 0.0])
    found, squares, spread = shrink(values * (np.diag(H) > 0), H, np.ones(6))
    # Of the lenses the drive shows one term, three times as large as expected.
    assert spread == pytest.approx(9.0, rel=1e-3)
    expected = [1e-6, 0.5 + 0.4**2, 1 / 101 + (0.3 - found[2]) ** 2, 1.0, 1e-4, 9.0]
    np.testing.assert_allclose(np.diag(squares), expected, rtol=2e-3)
    # What was corrected before is part of what lenses bend.
    kept, _, spread = shrink(np.zeros(6), H, np.ones(6), values)
    assert spread == pytest.approx(9.0, rel=1e-2)
    assert not kept.any()
    assert shrink(np.zeros(4), np.zeros((4, 4)), np.ones(4))[2] == 1.0


NODS = np.stack([exp_so3(np.array([0.06 * np.sin(0.9 * k), 0.0, 0.0])) for k in range(FRAMES)])


def warped(part: StereoTracks, nods: np.ndarray = NODS) -> StereoTracks:
    """The tracks in images that are warped one by one, as if the cameras had nodded."""

    def nodded(uv: np.ndarray, cx_px: float) -> np.ndarray:
        K = CAMERA.matrix.copy()
        K[0, 2] = cx_px
        rays = np.concatenate([uv, np.ones((*uv.shape[:2], 1))], axis=-1) @ np.linalg.inv(K).T
        there = rays @ nods @ K.T
        return there[..., :2] / there[..., 2:]

    left_uv = nodded(part.window.uvd[..., :2], CAMERA.cx_px)
    right_uv = nodded(part.right_uv, CAMERA.cx_right_px)
    poses = part.window.T_world_camera.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ nods
    uvd = np.concatenate([left_uv, left_uv[..., :1] - right_uv[..., :1]], axis=-1)
    return StereoTracks(TrackWindow(poses, uvd, part.window.xyz_world), right_uv)


def test_a_fault_that_turns_with_what_is_seen_is_none_of_the_rig():
    values = fault(left_k1=0.02, right_s3=0.02, right_s4=-0.02)
    stays = fit_fault([tracks(values, k, nods=NODS) for k in range(WINDOWS)], FAULT, ALL)
    turning = fit_fault([warped(tracks(values, k)) for k in range(WINDOWS)], FAULT, ALL)
    assert stays.fixed
    assert rms(off_px(values, stays.values)).max() < 0.1
    assert not turning.fixed
    assert not turning.values.any()
    # What is left is stated: the error of the rig as it stays.
    squares = off_squares(turning)
    assert np.sqrt(squares.mean()) > 0.5 * rms(off_px(values, NONE))[1]
    # A window in which the images are calm says nothing, and does not outvote the others.
    calm = [warped(tracks(values, k), NODS[:1].repeat(FRAMES, axis=0)) for k in range(2)]
    rest = [warped(tracks(values, k)) for k in range(2, WINDOWS)]
    assert not fit_fault([*calm, *rest], FAULT, ALL).fixed
    nothing = fit_fault([warped(tracks(NONE, k)) for k in range(WINDOWS)], FAULT, ALL)
    assert rms(off_px(NONE, nothing.values)).max() < 0.05


def test_on_a_straight_road_chance_does_not_tell_that_a_fault_turns(monkeypatch):
    """Noise that tilts the poses of a window makes rows vary less, by next to nothing."""
    monkeypatch.setitem(globals(), "step", lambda m: make_transform(np.eye(3), np.array([0, 0, m])))
    values = fault(zoom=-1e-3)
    windows = [tracks(values, 2000 + k) for k in range(WINDOWS)]
    windows = [replace(part, window=adjust(part.window, CAMERA)) for part in windows]
    found = fit_fault(windows, FAULT, ALL)
    assert found.fixed
    assert rms(off_px(values, found.values))[0] < 0.05
    assert not turns(windows, FAULT, NONE)


def off_squares(found: FittedFault) -> np.ndarray:
    """Mean squares (N,) of disparity errors, as a fit states them."""
    places = FAULT.correct(*seen(XYZ, NONE), NONE)
    by = (places.by_left - places.by_right)[:, 0]
    return np.einsum("ni,ij,nj->n", by, found.covariance, by)


def test_features_that_lie_alike_and_err_alike_make_intervals_wider():
    def spoiled(seed: int) -> StereoTracks:
        part = tracks(NONE, seed)
        near = part.window.uvd[..., :1] - part.right_uv[..., :1] > 30.0
        return replace(part, right_uv=part.right_uv + np.where(near, [0.5, 0.0], 0.0))

    clean = fitted(NONE)
    found = fit_fault([spoiled(k) for k in range(WINDOWS)], FAULT, ALL)
    # Windows agree: all are wrong in the same way.
    assert found.scatter < 1.5
    # So are halves of their features, which do not.
    assert found.length > 1.3 * clean.length
    assert off_squares(found).mean() > 1.5 * off_squares(clean).mean()
    assert np.mean(off_px(NONE, found.values)[:, 1] ** 2 < 1.96**2 * off_squares(found)) > 0.95


@pytest.mark.parametrize("points", [0, 1, 3])
def test_of_windows_with_hardly_a_feature_nothing_fails(points: int):
    whole = [tracks(NONE, k) for k in range(WINDOWS)]
    w, right_uv = whole[0].window, whole[0].right_uv[:, :points]
    few = TrackWindow(w.T_world_camera, w.uvd[:, :points], w.xyz_world[:points])
    found = fit_fault([StereoTracks(few, right_uv), *whole[1:]], FAULT, ALL)
    assert found.fixed
    assert rms(off_px(NONE, found.values)).max() < 0.05


@pytest.mark.parametrize("values", [fault(yaw=2e-4), fault(zoom=-5e-4), 0.1 * LENSES])
def test_a_path_becomes_longer_with_a_fault_as_is_said(values):
    windows = [tracks(values, k) for k in range(WINDOWS)]
    found = fit_fault(windows, FAULT, ALL)
    paths = [adjust(part.window, CAMERA).T_world_camera[-1, :3, 3] for part in windows]
    longer = 1.0 - np.linalg.norm(paths, axis=1).mean() / (FRAMES - 1)
    assert abs(longer) > 3e-4
    assert found.lengthening @ values == pytest.approx(longer, rel=0.2)


def with_lens(**changes: object) -> StereoCalibration:
    rig = raw_rig()
    return replace(rig, right=replace(rig.right, **changes))


@pytest.mark.parametrize(
    ("rig", "bends"),
    [
        (CAMERA, True),
        (raw_rig(), True),
        (with_lens(distortion=in_opencv(1e-3 * np.ones(len(LENS)))), True),
        (with_lens(distortion=np.array([-0.1, 0.02, 0, 0, 0, 0.1, 0, 0])), False),
        (with_lens(distortion=np.array([-0.1, 0.02, 0, 0]), model="fisheye"), False),
    ],
    ids=["rectified", "plain", "prisms", "rational", "fisheye"],
)
def test_lenses_of_other_models_are_left_as_they_are(rig, *, bends):
    assert may_bend(rig) == bends
    assert active(rig)[:4].all()
    assert (active(rig)[4:] == bends).all()
    if not bends:
        refined = without_fault(rig, turns_of(rig, SETTINGS), TURN)
        np.testing.assert_array_equal(refined.right.distortion, rig.right.distortion)
        assert refined.left is rig.left
