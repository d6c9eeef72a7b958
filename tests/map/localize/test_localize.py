"""A drive is found in the map of its street alone, by its views and its surfaces."""

from dataclasses import replace

import numpy as np
import pytest

from recon.core.errors import FormatError, MappingError
from recon.core.geometry import se3
from recon.core.geometry.se3 import apply, as_transform, step_covariance
from recon.core.kernels.voxels import pack_keys
from recon.map.drive.drive import Workspace
from recon.map.drive.sequence import map_sequence
from recon.map.localize import localizer as localizer_file
from recon.map.localize.localizer import State
from recon.map.localize.sequence import LocalizedDrive, StartPose, localize_sequence, open_localizer
from recon.map.localize.surroundings import (
    NOISE,
    Correction,
    Fit,
    contrast,
    describe_surfaces,
    fit_surfaces,
    is_worthwhile,
)
from recon.map.map import Map
from recon.map.settings import DriveSettings
from recon.map.store.session import SessionInfo
from recon.odometry.protocol import OdometryFrame
from recon.stereo.frame import FrameReconstructor
from recon.street.settings import StreetScene
from tests.scenery.film import RIG, Film, film

STREET = StreetScene(frames=16, seed=1, **RIG)
SETTINGS = DriveSettings()


@pytest.fixture(scope="module")
def street():
    return film(STREET)


@pytest.fixture(scope="module")
def truth(street):
    return street.trajectory.T_world_camera


@pytest.fixture(scope="module")
def street_map(street, truth):
    made = Map.temporary()
    even = street.taken(slice(0, None, 2))
    map_sequence(even, SETTINGS, known_poses=even.trajectory, workspace=Workspace(made))
    return made


@pytest.fixture(scope="module")
def odd(street, street_map):
    return _localized(street.taken(slice(1, None, 2)), street_map)


def _localized(source: Film, map_: Map, start: StartPose | None = None) -> LocalizedDrive:
    return localize_sequence(source, Workspace(map_), SETTINGS, start=start)


def _errors(drive: LocalizedDrive, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the frames that have a pose: metres and degrees."""
    placed = [frame.index for frame in drive.placed]
    off = se3.invert(truth[placed]) @ drive.trajectory.T_world_camera
    return np.linalg.norm(off[:, :3, 3], axis=1), np.degrees(se3.angle_rad(off))


def test_frames_between_those_of_the_map_are_found_to_centimetres(odd, truth):
    error_m, error_deg = _errors(odd, truth[1::2])
    assert [frame.located.state for frame in odd.frames[1:]] == [State.TRACKING] * 7
    assert np.median(error_m) < 0.05
    assert error_m.max() < 0.2
    assert np.median(error_deg) < 0.15
    assert odd.figures().to_json()["first_fix_frame"] <= 1
    for frame in odd.tracked:
        off = se3.as_step(se3.invert(truth[2 * frame.index + 1]) @ frame.located.T_world_camera)
        assert off @ np.linalg.solve(frame.located.covariance, off) < 22.5  # 0.1 %, six freedoms


@pytest.mark.parametrize(("frames", "change"), [
    (slice(1, None, 2), lambda image: np.clip(0.6 * image + 10.0, 0, 255).astype(np.uint8)),
    (slice(1, None, 2), lambda image: (255 * (image / 255.0) ** 1.5).astype(np.uint8)),
    (slice(11, None, -2), None),
], ids=["darker", "gamma", "backwards"])  # fmt: skip
def test_another_light_or_direction_makes_no_difference(street, street_map, truth, frames, change):
    drive = _localized(street.taken(frames, change), street_map)
    error_m, _ = _errors(drive, truth[frames])
    assert len(drive.tracked) >= len(drive.frames) - (1 if change is None else 2)
    assert error_m.max() < (0.2 if change is None else 0.3)


def test_in_a_hurry_frames_coast_by_odometry_alone(street, street_map, truth):
    localizer = open_localizer(street_map, SETTINGS)
    match = FrameReconstructor(street.calibration, SETTINGS).match
    frames = [OdometryFrame(*match(pair)) for pair in street.taken(slice(1, 8))]
    found = [localizer.add(frame, hurried=lambda n=n: n >= 3) for n, frame in enumerate(frames)]
    by_odometry = [place for place in found[2:] if place.state is State.COASTING]
    assert [place.views > 0 for place in found[2:]] == [
        place.state is State.TRACKING for place in found[2:]
    ]
    assert len(by_odometry) >= 2
    for place in by_odometry:
        sigma_m = np.sqrt(np.linalg.eigvalsh(place.covariance[:3, :3])[-1])
        assert sigma_m <= localizer_file._SURE_SIGMA_M
    off = se3.invert(truth[7]) @ found[-1].T_world_camera
    assert np.linalg.norm(off[:3, 3]) < 0.3


def test_frames_that_are_matched_roughly_are_corrected_by_one_view_alone(street, street_map, truth):
    localizer = open_localizer(street_map, SETTINGS)
    match = FrameReconstructor(street.calibration, SETTINGS).match_roughly
    pairs = street.taken(slice(1, None, 2))
    found = [localizer.add(OdometryFrame(*match(pair), rough=True)) for pair in pairs]
    assert [place.state for place in found[1:]] == [State.TRACKING] * 7
    assert {(place.views, place.surfaces) for place in found[1:]} == {(1, False)}
    off = se3.invert(truth[3::2]) @ np.stack([place.T_world_camera for place in found[1:]])
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.2


def test_several_views_are_believed_against_odometry(street, street_map, truth):
    localizer = open_localizer(street_map, SETTINGS)
    match = FrameReconstructor(street.calibration, SETTINGS).match
    *before, last = (OdometryFrame(*match(pair)) for pair in street.taken(slice(1, 8, 2)))
    for frame in before:
        localizer.add(frame)
    belief = localizer._belief
    aside = belief.T_world_camera @ as_transform(np.array([0.8, 0.0, 0.0, 0.0, 0.0, 0.0]))
    localizer._belief = replace(belief, T_world_camera=aside)
    found = localizer.add(last)
    assert found.state is State.TRACKING
    assert np.linalg.norm((se3.invert(truth[7]) @ found.T_world_camera)[:3, 3]) < 0.1


def test_after_a_jump_to_a_place_that_is_not_in_the_map_the_drive_coasts_and_is_lost():
    """Two streets cut together, driven slowly: odometry hardly notices, the map knows nothing."""
    scene = STREET.model_copy(update={"frames": 6, "speed_m_per_frame": 0.19})
    here, elsewhere = film(scene), film(scene.model_copy(update={"seed": 2, "frames": 7}))
    made = Map.temporary()
    map_sequence(here, SETTINGS, known_poses=here.trajectory, workspace=Workspace(made))
    poses = np.concatenate([film.trajectory.T_world_camera for film in (here, elsewhere)])
    jumping = Film([*here.pairs, *elsewhere.pairs], here.calibration, poses)
    drive = _localized(jumping, made)
    before, after = drive.frames[len(here) - 1], drive.frames[len(here) :]
    assert before.located.state is State.TRACKING
    found = [frame.located for frame in after]
    assert not any(one.state is State.TRACKING for one in found)
    lost = [one.state for one in found].index(State.LOST)
    assert lost >= 2
    assert {one.state for one in found[:lost]} == {State.COASTING}
    sigmas_m = [one.sigma_m for one in (before.located, *found[:lost])]
    assert (np.diff(sigmas_m) > 0).all()
    assert all("coasting" in frame.state for frame in after[:lost])
    assert (
        drive.figures().to_json()["frames_coasting"]
        == lost
        == len(drive.placed) - len(drive.tracked)
    )
    coasting, lost_once = drive.warnings()
    assert "on odometry alone" in coasting
    assert "lost once" in lost_once


def test_a_blinded_camera_is_lost_and_found_again(street, street_map, truth):
    odd = street.taken(slice(1, None, 2))
    black = replace(odd.pairs[0], left=0 * odd.pairs[0].left, right=0 * odd.pairs[0].right)
    odd.pairs[4] = odd.pairs[5] = black
    drive = _localized(odd, street_map)
    states = [frame.located.state for frame in drive.frames]
    assert states[3] is State.TRACKING
    assert State.TRACKING not in states[4:6]
    assert states[-1] is State.TRACKING
    assert _errors(drive, truth[1::2])[0].max() < 0.3


def test_a_start_pose_narrows_the_search(street, street_map, truth):
    odd = street.taken(slice(1, 6, 2))
    T_map_camera = street_map.session().T_map_world @ truth[1]
    x_m, y_m = T_map_camera[:2, 3]
    yaw_deg = np.degrees(np.arctan2(T_map_camera[1, 2], T_map_camera[0, 2]))
    assert _localized(odd, street_map, StartPose(x_m, y_m, yaw_deg)).tracked
    beyond = StartPose(x_m + 19.0, y_m, yaw_deg)
    assert not _localized(odd, street_map, beyond).tracked
    for wrong in (StartPose(x_m + 200.0, y_m, yaw_deg), StartPose(x_m, y_m, yaw_deg + 180.0)):
        with pytest.raises(MappingError, match="no keyframe of the map is near the start"):
            _localized(odd, street_map, wrong)


def test_a_damaged_map_or_one_without_keyframes_is_refused(street, street_map):
    damaged, empty = Map.temporary(), Map.temporary()
    empty.begin(SessionInfo())
    with pytest.raises(MappingError, match="no keyframes"):
        open_localizer(empty, SETTINGS)
    for kind in street_map.store.kinds():
        street_map.store.copy(kind, damaged.store)
    damaged.store.put("view", (0, 4), {"keyframe": {}})
    with pytest.raises(FormatError):
        _localized(street.taken(slice(1, 4, 2)), Map(damaged.store))


@pytest.mark.slow
def test_where_a_street_repeats_itself_no_place_is_believed():
    """Each place of the drive is in the map twice, 40 m apart; either could be right."""
    scene = STREET.model_copy(update={"path": "straight", "repeat_m": 40.0, "frames": 56})
    repeated = film(scene.model_copy(update={"speed_m_per_frame": 1.5}))
    made = Map.temporary()
    map_sequence(repeated.taken(slice(0, None, 2)), SETTINGS, workspace=Workspace(made))
    drive = _localized(repeated.taken(slice(7, 20, 2)), made)
    assert {frame.located.state for frame in drive.frames} == {State.SEARCHING}


def wall(points: int = 3000, noise_m: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(2)
    xy = rng.uniform(-4, 4, (points, 2))
    return np.c_[xy, 5.5 + noise_m * rng.normal(size=points)]


@pytest.mark.parametrize("shift_m", [0.0, 0.05, 0.2, -0.3])
def test_the_residual_is_the_distance_to_the_wall(shift_m):
    moved = wall() + np.array([0.0, 0.0, shift_m])
    fit = fit_surfaces(moved, describe_surfaces(wall(), 1.0))
    assert fit.residual_m == pytest.approx(abs(shift_m), rel=1e-6, abs=1e-9)
    assert (fit.overlap == 1.0) or shift_m
    assert fit_surfaces(moved, describe_surfaces(moved[:0], 1.0)).overlap == 0.0


def test_a_bush_fixes_nothing():
    bush = np.random.default_rng(4).uniform(-4, 4, (20_000, 3))
    fit = fit_surfaces(bush, describe_surfaces(bush, 1.0))
    assert fit.overlap == 1.0
    assert np.isnan(fit.residual_m)
    np.testing.assert_array_equal(fit.information, 0.0)
    np.testing.assert_array_equal(describe_surfaces(wall(5), 100.0).information, 0.0)


def test_information_is_the_curvature_of_the_squared_distance():
    """Second difference of the cost along each step against the diagonal."""
    xyz = wall(noise_m=0.03)
    surfaces = describe_surfaces(xyz, 1.0)
    fit = fit_surfaces(xyz, surfaces)
    h = 1e-4

    def cost(step: np.ndarray) -> float:
        moved = apply(as_transform(step), xyz)
        # Cells stay as they are for so small a step but for points on their rims.
        return sum(
            float((p - m) @ W @ (p - m)) for p, m, W in zip(moved, means, information, strict=True)
        )

    cell = np.searchsorted(surfaces.keys, pack_keys(np.floor(xyz).astype(np.int64)))
    means, information = surfaces.means[cell], surfaces.information[cell]
    for axis, step in enumerate(h * np.eye(6)):
        curvature = (cost(step) - 2 * cost(np.zeros(6)) + cost(-step)) / (2 * h * h)
        # The rest of the curvature is the residuals' own, some 1/1000 here.
        assert curvature == pytest.approx(fit.information[axis, axis], rel=0.02, abs=1 / NOISE**2)


UNSURE = step_covariance(0.3, 1.0)
SURE = step_covariance(0.002, 0.005)
ALONG = SURE + np.diag([0.0, 0.0, 0.3**2, 0.0, 0.0, 0.0])


def corridor(ends: bool) -> np.ndarray:
    """Points (N, 3) on ground, ceiling and walls along z, with or without walls across it."""
    rng = np.random.default_rng(5)
    n = 4000
    x, y, z = rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), rng.uniform(-12, 12, n)
    planes = [np.c_[x, np.full(n, s * 2.05), z] for s in (-1, 1)]
    planes += [np.c_[np.full(n, s * 3.05), y, z] for s in (-1, 1)]
    planes += [np.c_[x, y, np.full(n, s * 12.05)] for s in (-1, 1) if ends]
    return np.concatenate(planes)


def corrected(xyz: np.ndarray, step: np.ndarray) -> Correction:
    """ICP would move a frame by ``step``, and would fit the map better there."""
    surfaces = describe_surfaces(xyz, 1.0)
    # Not to where an open corridor ends: there the map does.
    along_m = np.abs(xyz[:, 2])
    seen = xyz[(along_m < 11.0) | (along_m > 12.0)][::7]
    fit = fit_surfaces(seen, surfaces)
    before = Fit(fit.overlap, 0.2, fit.information)
    beside = contrast(seen, np.eye(4), surfaces)
    return Correction(step, before, Fit(fit.overlap, 0.1, fit.information), beside)


@pytest.mark.parametrize(("step_m", "ends", "prior", "worth"), [
    ((0.1, 0.05, 0.4), True, UNSURE, True),
    ((0.0, 0.0, 0.0), True, UNSURE, True),
    ((2.0, 0.0, 0.0), True, UNSURE, False),  # far outside both uncertainties
    ((0.01, 0.0, 0.01), True, SURE, False),
    ((0.1, 0.05, 0.0), True, UNSURE, True),
    # A corridor that goes on fits as well half a metre on, whatever it says of the sides.
    ((0.1, 0.05, 0.0), False, UNSURE, False),
    # A prior that is sure of all but the way along it stays.
    ((0.0, 0.0, 0.1), False, ALONG, False),
    ((0.0, 0.0, 0.1), True, ALONG, True),
])  # fmt: skip
def test_surfaces_correct_a_pose_that_they_know_better(step_m, ends, prior, worth):
    step = np.array([*step_m, 0.0, 0.0, 0.0])
    assert is_worthwhile(corrected(corridor(ends), step), prior) is worth


def test_a_correction_must_fit_better():
    information, nan = np.eye(6) * 1e5, float("nan")
    for before, after, overlap, worth in (
        (0.1, 0.05, 0.9, True), (0.1, 0.05, 0.3, False), (0.1, 0.1, 0.9, False),
        (0.1, 0.2, 0.9, False), (nan, nan, 0.9, False),
    ):  # fmt: skip
        fits = (Fit(overlap, residual_m, information) for residual_m in (before, after))
        assert is_worthwhile(Correction(np.full(6, 0.01), *fits, 1e4), UNSURE) is worth
