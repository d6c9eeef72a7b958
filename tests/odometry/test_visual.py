from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from recon.core.geometry.se3 import angle_rad, exp_so3, invert, make_transform
from recon.core.values import Disparity
from recon.odometry.features import in_crowd
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.odometry.visual import VisualOdometry
from recon.stereo.match.sad import HalfSizeMatcher, SadSettings
from tests.odometry.conftest import See, off_m

Street = tuple[OdometryFrame, ...]


def register(frames: Sequence[OdometryFrame]) -> list[OdometryResult]:
    odometry = VisualOdometry()
    return [odometry.register(frame) for frame in frames]


def path_of(results: list[OdometryResult]) -> np.ndarray:
    return np.stack([result.T_world_camera for result in results])


@pytest.fixture(scope="module")
def results(street: Street) -> list[OdometryResult]:
    return register(street)


def yaw(angle_rad: float) -> np.ndarray:
    return make_transform(exp_so3(np.array([0.0, angle_rad, 0.0])), np.zeros(3))


def forward(distance_m: float) -> np.ndarray:
    return make_transform(np.eye(3), np.array([0.0, 0.0, distance_m]))


def test_a_camera_that_stands_still_stays(see: See) -> None:
    poses = path_of(register([see(np.eye(4))] * 4))
    # Equal images: what is left is the optimiser's rounding.
    np.testing.assert_allclose(poses, np.tile(np.eye(4), (4, 1, 1)), atol=1e-4)


@pytest.mark.parametrize("step", [forward(0.5), yaw(0.02), forward(-0.3), forward(0.4) @ yaw(0.01)])
def test_a_motion_is_found(step: np.ndarray, see: See) -> None:
    truth = [np.linalg.matrix_power(step, n) for n in range(5)]
    last = register([see(T) for T in truth])[-1]
    # 1 % of a 2 m path; a quarter of a pixel (1/260 rad) in four frames, as patches that grow
    # or turn while they are followed cost some hundredths of a pixel each time.
    assert off_m(last, truth[-1]) < 0.02
    assert angle_rad(invert(last.T_world_camera) @ truth[-1]) < 0.25 / 260


def test_features_stay_spread_over_the_image_where_a_drive_backwards_gathers_them(
    street: Street,
) -> None:
    odometry = VisualOdometry()
    for frame in reversed(street):
        odometry.register(frame)
    newest = odometry.window.uvd[-1, odometry.window.seen[-1], :2]
    assert len(newest) > 50
    assert not in_crowd(newest, street[0].pair.left.shape).any()


def test_motion_begins_at_the_identity_wherever_the_drive_begins(
    street: Street, results: list[OdometryResult]
) -> None:
    late, whole = path_of(register(street[4:8])), path_of(results)
    np.testing.assert_array_equal(late[0], np.eye(4))
    relative = invert(whole[4]) @ whole[7]
    # Other frames were in the window; both are good to about 1 % of 1.5 m.
    assert np.linalg.norm(relative[:3, 3] - late[3][:3, 3]) < 0.03


def test_two_runs_are_equal_to_the_bit(street: Street, results: list[OdometryResult]) -> None:
    np.testing.assert_array_equal(path_of(register(street)), path_of(results))


def test_a_blank_wall_gives_no_motion_and_no_exception(blind: See) -> None:
    results = register([blind(128, n) for n in range(3)])
    assert [result.health.ok for result in results[:2]] == [True, False]
    np.testing.assert_allclose(results[2].T_world_camera, np.eye(4), atol=1e-12)


def test_an_object_that_moves_does_not_move_the_camera(see: See) -> None:
    """A third of the image shows the street from elsewhere, as on the side of a passing bus."""
    frames, third = [], np.s_[:, :133]
    for n in range(5):
        below, above = see(forward(0.4 * n), n), see(forward(-0.3 * n), n)
        grey, values = below.pair.left.copy(), below.disparity.values.copy()
        grey[third], values[third] = above.pair.left[third], above.disparity.values[third]
        pair = replace(below.pair, left=grey, right=grey)
        frames.append(OdometryFrame(pair, replace(below.disparity, values=values)))
    assert off_m(register(frames)[-1], forward(1.6)) < 0.05


def _without_disparity(street: Street, blind: See) -> list[OdometryFrame]:
    return [*street[:6], OdometryFrame(street[6].pair, blind().disparity), *street[7:]]


def _jump(street: Street, _: See) -> list[OdometryFrame]:
    """A jump of 2.5 m that the times do not show: tracks are lost, the pose is not."""
    late = [replace(f, pair=replace(f.pair, timestamp_s=0.1 * n)) for n, f in enumerate(street)]
    return [*late[:5], *late[9:]]


def _exposed(gain: float) -> Callable[[Street, See], list[OdometryFrame]]:
    def exposed(frame: OdometryFrame) -> OdometryFrame:
        grey = np.clip(np.rint(gain * frame.pair.left), 0, 255).astype(np.uint8)
        return replace(frame, pair=replace(frame.pair, left=grey, right=grey))

    return lambda street, _: [*street[:5], *map(exposed, street[5:])]


@pytest.mark.parametrize(
    ("spoil", "lost", "most_m"),
    [
        # The motion is constant, so the extrapolated step costs hardly more than a seen one.
        (lambda street, blind: [*street[:6], blind(index=6), *street[7:]], [6], 0.1),
        # Measured across the gap: 2 m in one step, by patches that grew meanwhile.
        (
            lambda street, blind: [*street[:5], *(blind(index=n) for n in (5, 6, 7)), *street[8:]],
            [5, 6, 7],
            0.1,
        ),
        (_without_disparity, [], 0.06),
        # Some thirty features, placed to about a pixel; the last motion going on is 2 m off.
        (_jump, [], 0.2),
        (_exposed(0.5), [], 0.06),
        (_exposed(2.0), [], 0.06),
    ],
    ids=["black", "black for long", "no disparity", "frames missing", "dark", "bright"],
)
def test_what_is_lost_is_said_and_the_camera_found_again(
    spoil, lost: list[int], most_m: float, street: Street, street_poses: np.ndarray, blind: See
) -> None:
    results = register(spoil(street, blind))
    assert [n for n, result in enumerate(results) if not result.health.ok] == lost
    assert all("lost" in results[n].health.notes[0] for n in lost)
    assert off_m(results[-1], street_poses[-1]) < most_m


def test_a_drive_that_begins_blind_begins_where_it_sees(blind: See, street: Street) -> None:
    results = register([blind(), blind(), *street[:4]])
    np.testing.assert_allclose(results[2].T_world_camera, np.eye(4), atol=1e-12)
    assert [result.health.ok for result in results[:2]] == [True, False]
    assert results[-1].health.ok


def test_the_stated_error_of_a_motion_is_about_its_error(
    results: list[OdometryResult], street_poses: np.ndarray
) -> None:
    steps, truth = (invert(T[:-1]) @ T[1:] for T in (path_of(results), street_poses))
    off = np.linalg.norm((steps - truth)[:, :3, 3], axis=1)
    stated_m = np.array([result.health.sigma_m for result in results[1:]])
    # 1.06; eleven steps, of which neighbours share their features.
    assert 0.5 < np.sqrt(np.square(off / stated_m).mean()) < 2.0
    assert stated_m.max() < 0.05
    assert all(0.0 < result.health.sigma_deg < 0.5 for result in results[1:])


@pytest.mark.parametrize("error_px", [-0.3, 0.3])
def test_what_all_disparities_are_off_is_in_the_length_as_health_says(
    error_px: float, street: Street, results: list[OdometryResult]
) -> None:
    off = [Disparity.from_values(frame.disparity.values + error_px) for frame in street]
    wrong = register([replace(f, disparity=d) for f, d in zip(street, off, strict=True)])
    scale_px = np.mean([result.health.scale_px for result in results[1:]])
    lengths_m = [
        np.linalg.norm(np.diff(path_of(drive)[:, :3, 3], axis=0), axis=1).sum()
        for drive in (wrong, results)
    ]
    assert lengths_m[0] / lengths_m[1] - 1.0 == pytest.approx(-error_px / scale_px, rel=0.1)


def test_rough_disparities_give_nearly_the_same_path(
    see_both: See, street_poses: np.ndarray
) -> None:
    matcher = HalfSizeMatcher(SadSettings(), threads=1)
    pairs = [see_both(T, index).pair for index, T in enumerate(street_poses)]
    found = register([OdometryFrame(pair, matcher.match(pair), rough=True) for pair in pairs])
    # 2 % of the length; the first pose is the identity.
    assert off_m(found[-1], street_poses[-1]) < 0.02 * 0.5 * 11
