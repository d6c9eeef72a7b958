"""Visual odometry, alone and with an external trajectory as prior: any rate, world and axes."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import angle_rad, exp_so3, invert, make_transform
from recon.core.values import Disparity, Trajectory
from recon.odometry.checked import CheckedOdometry
from recon.odometry.features import in_crowd
from recon.odometry.health import segment_numbers
from recon.odometry.prior import MotionPrior, find_axes, first_moving
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.odometry.registry import make_odometry
from recon.odometry.settings import OdometrySettings, PriorSettings
from recon.odometry.visual import VisualOdometry
from recon.stereo.match.sad import HalfSizeMatcher
from recon.stereo.match.search import SearchSettings
from tests.odometry.conftest import STEP, See, make_frame, off_m, steps

Street = tuple[OdometryFrame, ...]


def register(frames: Sequence[OdometryFrame]) -> list[OdometryResult]:
    odometry = VisualOdometry()
    return [odometry.register(frame) for frame in frames]


def path_of(results: list[OdometryResult]) -> np.ndarray:
    return np.stack([result.T_world_camera for result in results])


@pytest.fixture(scope="module")
def results(street):
    return register(street)


def yaw(angle_rad: float) -> np.ndarray:
    return make_transform(exp_so3(np.array([0.0, angle_rad, 0.0])), np.zeros(3))


def forward(distance_m: float) -> np.ndarray:
    return make_transform(np.eye(3), np.array([0.0, 0.0, distance_m]))


def test_a_still_camera_stays_and_a_blank_wall_gives_no_motion(see, blind):
    poses = path_of(register([see(np.eye(4))] * 4))
    # Equal images: what is left is the optimiser's rounding.
    np.testing.assert_allclose(poses, np.tile(np.eye(4), (4, 1, 1)), atol=1e-4)
    results = register([blind(128, n) for n in range(3)])
    assert not any(result.health.ok for result in results)
    np.testing.assert_allclose(results[2].T_world_camera, np.eye(4), atol=1e-12)


@pytest.mark.parametrize("step", [forward(0.5), yaw(0.02), forward(-0.3), forward(0.4) @ yaw(0.01)])
def test_a_motion_is_found(step, see):
    truth = [np.linalg.matrix_power(step, n) for n in range(5)]
    last = register([see(T) for T in truth])[-1]
    # 1 % of a 2 m path; a quarter of a pixel (1/260 rad) in four frames, as patches that grow
    # or turn while they are followed cost some hundredths of a pixel each time.
    assert off_m(last, truth[-1]) < 0.02
    assert angle_rad(invert(last.T_world_camera) @ truth[-1]) < 0.25 / 260


def test_features_stay_spread_over_the_image_where_a_drive_backwards_gathers_them(street):
    odometry = VisualOdometry()
    for frame in reversed(street):
        odometry.register(frame)
    newest = odometry.window.uvd[-1, odometry.window.seen[-1], :2]
    assert len(newest) > 50
    assert not in_crowd(newest, street[0].pair.left.shape).any()


def test_an_object_that_moves_does_not_move_the_camera(see):
    """A third of the image shows the street from elsewhere, as on the side of a passing bus."""
    frames, third = [], np.s_[:, :133]
    for n in range(5):
        below, above = see(forward(0.4 * n), n), see(forward(-0.3 * n), n)
        grey, values = below.pair.left.copy(), below.disparity.values.copy()
        grey[third], values[third] = above.pair.left[third], above.disparity.values[third]
        pair = replace(below.pair, left=grey, right=grey)
        frames.append(OdometryFrame(pair, replace(below.disparity, values=values)))
    assert off_m(register(frames)[-1], forward(1.6)) < 0.05


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
        (lambda s, b: [*s[:6], b(index=6), *s[7:]], [6], 0.1),
        # Measured across the gap: 2 m in one step, by patches that grew meanwhile.
        (lambda s, b: [*s[:5], *(b(index=n) for n in (5, 6, 7)), *s[8:]], [5, 6, 7], 0.1),
        (lambda s, b: [*s[:6], OdometryFrame(s[6].pair, b().disparity), *s[7:]], [], 0.06),
        # Some thirty features, placed to about a pixel.
        (_jump, [], 0.2),
        (_exposed(0.5), [], 0.06),
        (_exposed(2.0), [], 0.06),
    ],
    ids=["black", "black for long", "no disparity", "frames missing", "dark", "bright"],
)
def test_what_is_lost_is_said_and_the_camera_found_again(
    spoil, lost, most_m, street, street_poses, blind
):
    results = register(spoil(street, blind))
    assert [n for n, result in enumerate(results) if not result.health.ok] == lost
    assert all("lost" in results[n].health.notes[0] for n in lost)
    assert off_m(results[-1], street_poses[-1]) < most_m


def test_where_nothing_is_seen_again_the_path_begins_anew(street, street_poses):
    """From frame 5 on another street: the same one in a mirror, where the motion is the same."""
    mirrored = [make_frame(f.pair.left[::-1], f.disparity.values[::-1], n)
                for n, f in enumerate(street)]  # fmt: skip
    results = register([*street[:5], *mirrored[5:]])
    assert all(result.health.ok for result in results)
    assert [n for n, result in enumerate(results) if result.health.begins] == [5]
    assert "a new segment begins" in results[5].health.notes[0]
    T_begun_last = invert(results[5].T_world_camera) @ results[-1].T_world_camera
    truth = invert(street_poses[5]) @ street_poses[-1]
    assert np.linalg.norm((invert(truth) @ T_begun_last)[:3, 3]) < 0.1


def test_a_drive_that_begins_blind_begins_where_it_sees(blind, street):
    odometry = CheckedOdometry(VisualOdometry())
    results = [odometry.register(frame) for frame in [blind(), blind(), *street[:4]]]
    np.testing.assert_allclose(results[2].T_world_camera, np.eye(4), atol=1e-12)
    # One stretch: there is nothing before it to be apart from.
    assert segment_numbers([result.health for result in results]).tolist() == [-1, -1, 0, 0, 0, 0]


def test_the_stated_error_of_a_motion_is_about_its_error(results, street_poses):
    steps, truth = (invert(T[:-1]) @ T[1:] for T in (path_of(results), street_poses))
    off = np.linalg.norm((steps - truth)[:, :3, 3], axis=1)
    stated_m = np.array([result.health.sigma_m for result in results[1:]])
    # 1.06; eleven steps, of which neighbours share their features.
    assert 0.5 < np.sqrt(np.square(off / stated_m).mean()) < 2.0
    assert stated_m.max() < 0.05
    assert all(0.0 < result.health.sigma_deg < 0.5 for result in results[1:])


@pytest.mark.parametrize("error_px", [-0.3, 0.3])
def test_what_all_disparities_are_off_is_in_the_length_as_health_says(error_px, street, results):
    off = [Disparity.from_values(frame.disparity.values + error_px) for frame in street]
    wrong = register([replace(f, disparity=d) for f, d in zip(street, off, strict=True)])
    scale_px = np.mean([result.health.scale_px for result in results[1:]])
    lengths_m = [
        np.linalg.norm(np.diff(path_of(drive)[:, :3, 3], axis=0), axis=1).sum()
        for drive in (wrong, results)
    ]
    assert lengths_m[0] / lengths_m[1] - 1.0 == pytest.approx(-error_px / scale_px, rel=0.1)


def test_rough_disparities_give_nearly_the_same_path(see_both, street_poses):
    matcher = HalfSizeMatcher(SearchSettings(), threads=1)
    pairs = [see_both(T, index).pair for index, T in enumerate(street_poses)]
    found = register([OdometryFrame(pair, matcher.match(pair), rough=True) for pair in pairs])
    # 2 % of the length; the first pose is the identity.
    assert off_m(found[-1], street_poses[-1]) < 0.02 * 0.5 * 11


ELSEWHERE = make_transform(exp_so3(np.array([0.3, -1.2, 0.4])), np.array([500.0, -20.0, 3.0]))
CAMERA_FROM_BODY = make_transform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3)
)


def path(poses: np.ndarray, interval_s: float = 0.1, start_s: float = 0.0) -> Trajectory:
    """The poses in another world, as a receiver would give them."""
    times_s = start_s + interval_s * np.arange(len(poses))
    return Trajectory(ELSEWHERE @ poses, times_s)


def led_by(
    frames: list[OdometryFrame], prior: Trajectory | None, name: str = "visual"
) -> list[OdometryResult]:
    odometry = make_odometry(name, OdometrySettings(), prior)
    return [odometry.register(frame) for frame in frames]


def test_motions_of_a_path_are_those_of_the_camera_in_any_world_rate_and_axes():
    prior = MotionPrior(path(steps(5)), PriorSettings())
    # Positions of 500 m have 1e-13 of them as rounding.
    np.testing.assert_allclose(prior.motion(0.1, 0.2), STEP, atol=1e-9)
    coarse = MotionPrior(path(steps(9)[::4], interval_s=0.4), PriorSettings())
    found = coarse.motion(0.1, 0.2)
    # A chord of an arc of 0.04 rad and 2 m: 2 m · 0.04 / 8 to the side at most.
    np.testing.assert_allclose(found, STEP, atol=0.01)
    body = np.stack([T @ CAMERA_FROM_BODY for T in steps(4)])
    prior = MotionPrior(path(body), PriorSettings(axes="body"))
    np.testing.assert_allclose(prior.motion(0.0, 0.1), STEP, atol=1e-9)


@pytest.mark.parametrize(("from_s", "to_s"), [(-0.1, 0.1), (0.3, 0.6), (0.2, 0.2), (0.2, 0.1)])
def test_outside_of_the_path_and_across_a_gap_nothing_is_reported(from_s, to_s):
    assert MotionPrior(path(steps(5)), PriorSettings()).motion(from_s, to_s) is None
    gappy = MotionPrior(path(steps(3), interval_s=2.0), PriorSettings())
    assert gappy.motion(0.5, 0.6) is None


def test_what_is_no_path_of_the_drive_is_refused():
    prior = MotionPrior(path(steps(5), start_s=1.7e9), PriorSettings())
    with pytest.raises(RegistrationError, match=r"does not cover the drive.*same clock"):
        prior.check_covers(0.1 * np.arange(10))
    # One that covers a part is taken.
    MotionPrior(path(steps(5), start_s=0.45), PriorSettings()).check_covers(0.1 * np.arange(20))
    with pytest.raises(RegistrationError, match="two poses"):
        MotionPrior(path(steps(1)), PriorSettings())


def test_frames_without_sight_are_carried_by_the_prior(see, blind):
    """The camera turns sharply while it is blind: the last motion going on would be far off."""
    turn = make_transform(exp_so3(np.array([0.0, 0.08, 0.0])), np.array([0.0, 0.0, 0.3]))
    truth = list(steps(4))
    for _ in range(5):
        truth.append(truth[-1] @ turn)
    frames = [see(T, n) for n, T in enumerate(truth[:4])]
    frames += [blind(index=n) for n in range(4, len(truth))]
    alone = led_by(frames, None)
    carried = led_by(frames, path(np.stack(truth)))
    assert not alone[-1].health.ok
    assert off_m(alone[-1], truth[-1]) > 0.5
    assert all(result.health.ok for result in carried)
    assert "carried by the prior" in carried[-1].health.notes[0]
    registered = led_by(frames, path(np.stack(truth)), "kiss")[-1].health
    assert registered.ok
    assert "carried by the prior" in registered.notes[1]
    # The prior is exact; what is left is the error of the seen motion before.
    assert off_m(carried[-1], truth[-1]) < 0.06


def test_a_prior_that_is_a_little_off_hardly_moves_what_is_seen(street, street_poses):
    """Wheels that are 3 % too large: features know better."""
    poses = street_poses.copy()
    poses[:, :3, 3] *= 1.03
    alone, led = (led_by(list(street), prior) for prior in (None, path(poses)))
    assert all(result.health.ok for result in led)
    assert off_m(led[-1], street_poses[-1]) < off_m(alone[-1], street_poses[-1]) + 0.02


def test_features_that_stand_still_do_not_outvote_the_wheels(see):
    """An image that stays the same while the wheels turn, as behind a lorry or a dirty lens."""
    still = [see(np.eye(4), 0)] * 3
    frames = [replace(f, pair=replace(f.pair, timestamp_s=0.1 * n)) for n, f in enumerate(still)]
    results = led_by(frames, path(steps(3)))
    assert off_m(results[-1], np.linalg.matrix_power(STEP, 2)) < 1e-6
    assert "features contradict the prior" in results[-1].health.notes[0]
    # Who is right is open, and the image is against the wheels.
    assert not results[-1].health.ok


AXES = {"camera": np.eye(4), "body": CAMERA_FROM_BODY}


@pytest.fixture(scope="module")
def frames(see):
    return [see(T, n) for n, T in enumerate(steps(7))]


def prior(T_camera_body: np.ndarray, step: np.ndarray = STEP, count: int = 8) -> Trajectory:
    poses = steps(count, step) @ T_camera_body
    return Trajectory(invert(poses[0]) @ poses, 0.1 * np.arange(count))


@pytest.mark.parametrize("axes", AXES)
def test_the_axes_of_a_path_are_found(frames, axes):
    found = find_axes(prior(AXES[axes]), iter(frames), PriorSettings())
    assert found.axes == axes
    # The path is exact, so its own standard deviation of 3 % is never used up.
    assert found.sigmas[axes] < 1
    assert max(found.sigmas.values()) > 5


def test_a_body_near_the_camera_and_a_scale_two_per_cent_off_are_recognised(frames):
    lever = make_transform(exp_so3(np.array([0.02, 0.0, 0.03])), np.array([0.3, 0.5, -0.2]))
    step = STEP.copy()
    step[:3, 3] *= 1.02
    found = find_axes(prior(CAMERA_FROM_BODY @ lever, step), iter(frames), PriorSettings())
    assert found.axes == "body"


def test_a_path_of_other_axes_is_refused_and_without_motion_they_stay_open(frames, see):
    backwards = make_transform(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    with pytest.raises(RegistrationError, match=r"does not fit what the cameras see.*body"):
        find_axes(prior(backwards), iter(frames), PriorSettings())
    still = [see(np.eye(4), n) for n in range(4)]
    assert find_axes(prior(np.eye(4), np.eye(4)), iter(still), PriorSettings()) is None


def test_the_first_moving_frame_is_found_from_the_path_alone():
    moved = np.concatenate([np.zeros(20), 0.05 * np.arange(40)])
    poses = np.stack([make_transform(np.eye(3), np.array([x, 0.0, 0.0])) for x in moved])
    path = Trajectory(poses, 0.1 * np.arange(60))
    # Of the frames until 0.3 m are covered, those before the path moves are of no use.
    assert first_moving(path, 0.1 * np.arange(5, 60), PriorSettings()) == 15
