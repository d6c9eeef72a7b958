"""The rig of a rendered drive is refined where it is off, and only there."""

import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import RectifiedCamera, Rig, SequenceTruth, StereoPair, Trajectory
from recon.look.look import refine_rig
from recon.look.rig import MIN_WINDOWS, KnownRig, RefinedRig, RigChange, compare_rigs, rig_shown
from recon.look.tracks import LiveTracks
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult
from recon.odometry.settings import RigSettings
from recon.odometry.visual import VisualOdometry
from recon.sources.live import LiveSource
from recon.sources.source import SourcePart, StereoSource
from recon.stereo.frame import FrameReconstructor
from recon.stereo.rectify.epipolar import correct_rig
from recon.stereo.rectify.rectifier import turns_of
from recon.street.render import StreetCamera
from recon.street.settings import StreetScene
from recon.street.street import build_street
from tests.look import faults
from tests.scenery.film import Film, film

CONFIG = load_config()
AUTO = RigSettings()
FRAMES = 36  # as few as are refined
SIZE = {"width_px": 400, "height_px": 136, "focal_px": 225.0, "smooth_edges": False}


@pytest.fixture(scope="module")
def street():
    return film(StreetScene(frames=FRAMES, seed=3, **SIZE))


def turned_rig(camera, yaw_deg=0.0, enlarged=1.0, pitch_deg=0.0):
    """The rig that takes the images of `faults.turned`."""
    turn = np.array([*-np.radians([pitch_deg, yaw_deg, 0.0]), 1.0 / enlarged - 1.0])
    return correct_rig(camera, turn, np.eye(3))


def off(rig: Rig, other: Rig) -> RigChange:
    return compare_rigs(rig, other, 10.0, CONFIG.rectification)


@pytest.mark.parametrize(
    ("yaw_deg", "enlarged"),
    [(0.25, 1.0), (-0.25, 1.005), (0.0, 0.995)],
    ids=["yaw", "yaw and focal length", "focal length"],
)
def test_a_turned_right_camera_is_recovered_and_said(street, yaw_deg, enlarged):
    source = faults.turned(street, yaw_deg=yaw_deg, enlarged=enlarged)
    true = turned_rig(street.calibration, yaw_deg, enlarged)
    planted = off(street.calibration, true)
    rig = refine_rig(source, CONFIG, AUTO)
    assert rig.refined
    assert rig.calibration.baseline_m == pytest.approx(street.calibration.baseline_m, rel=1e-9)
    # A rig that is to be kept is as far off as it was, and that is in the length of the path.
    kept = replace(rig, calibration=rig.given)
    assert rig.length_ratio < kept.length_ratio
    assert "used is the calibration as it is" in kept.warnings()[0]
    left = off(true, rig.calibration)
    # Noise, and what is shrunk of a turn that lenses may share: three standard deviations.
    assert left.rms_px < 0.25 * planted.rms_px
    assert abs(left.mean_px) < 3.0 * rig.sigma_px
    assert rig.wrong_at(10.0)
    assert not rig.wrong_at(0.5)
    figures = json.loads(json.dumps(rig.figures().to_json(), allow_nan=False))
    assert figures["yaw_deg"] == pytest.approx(-yaw_deg, abs=0.065)
    # Lenses can share a focal length; what they see together is asked above.
    assert figures["focal_percent"] == pytest.approx(100 * (enlarged - 1), abs=0.15)
    # Of all passes together: a rig that was far off is fitted twice.
    yaw = figures["parameters"]["yaw"]
    assert np.degrees(yaw["value"]) == pytest.approx(figures["yaw_deg"], abs=1e-9)
    assert 0.0 < yaw["sigma"] < yaw["prior"]
    (warning,) = rig.warnings()
    assert "the rig is not as calibrated" in warning
    assert "rig.refine=off" in warning
    drive = rig.applied(source)
    assert drive.calibration is rig.calibration
    assert (len(drive), drive.name) == (len(source), source.name)
    # Later drives that are live, or too short, begin with it and end with it.
    known = KnownRig(rig.given, rig.calibration, rig.fitted, "session 0 (film)")
    for later in (LiveSource(source), SourcePart(source, 0, 5)):
        again = refine_rig(later, CONFIG, AUTO, known)
        assert again.applied(later).calibration is rig.calibration
        anew = {"frames": None, "sigma": None, "seconds": None}
        begun = {"begun_with": "session 0 (film)", "right_time_offset": anew}
        assert again.figures().to_json() == {**figures, **begun}
        assert "session 0 (film) showed" in again.warnings()[0]
    assert not refine_rig(source, CONFIG, RigSettings(refine=False), known).refined


def test_a_drive_that_arrives_shows_its_rig_by_every_second_part_of_it(street):
    source = faults.turned(street, yaw_deg=0.25)
    reconstructor, odometry = FrameReconstructor(source.calibration, CONFIG), VisualOdometry()
    tracks, lost = LiveTracks(odometry), OdometryResult(np.eye(4), OdometryHealth(ok=False))
    there = [OdometryFrame(*reconstructor.match(pair)) for pair in source.frames()]
    for n, frame in enumerate([*there, *there[::-1]]):
        tracks.add(n, frame, odometry.register(frame))
    rig = rig_shown(tracks.windows, source.calibration, CONFIG.rectification)
    assert rig.fitted.windows == len(tracks.windows) == MIN_WINDOWS
    assert np.degrees(rig.fitted.values[1]) == pytest.approx(-0.25, abs=0.1)
    few = rig_shown(tracks.windows[1:], source.calibration, CONFIG.rectification)
    assert (few.refined, few.figures().to_json()) == (False, {"refined": False})
    # A long drive is as few parts as a short one; where it is lost, nothing is seen.
    for n in range(2 * FRAMES, 10 * FRAMES):
        tracks.add(n, there[0], lost)
    assert len(tracks.windows) == 2


def test_a_clean_street_keeps_its_calibration(street):
    rig = refine_rig(street, CONFIG, AUTO)
    assert off(street.calibration, rig.calibration).rms_px <= 0.05
    assert not rig.wrong_at(10.0)
    assert (rig.warnings(), rig.refined) == ([], rig.calibration is not street.calibration)
    if not rig.refined:
        assert rig.applied(street) is street


@pytest.mark.slow
def test_cameras_that_are_not_in_step_do_not_look_turned():
    slow = film(StreetScene(frames=2 * FRAMES, seed=3, speed_m_per_frame=0.5, **SIZE))
    late = [replace(one, right=two.right) for one, two in pairwise(slow.pairs)][::2]
    rig = refine_rig(
        Film(late, slow.calibration, slow.trajectory.T_world_camera[::2]), CONFIG, AUTO
    )
    assert rig.fitted.time_offset == pytest.approx(0.5, rel=0.2)
    # Without the time the yaw would be -0.3°, and disparities 7.6 px off.
    assert abs(rig.figures().to_json()["yaw_deg"]) < 0.1
    assert off(slow.calibration, rig.calibration).rms_px < 0.8
    (line,) = (line for line in rig.warnings() if "after the left" in line)
    assert rig.warnings([line]) == [one for one in rig.warnings() if one != line]


def test_stabilised_images_are_said_of_the_drive_that_has_them(street):
    rig = refine_rig(street, CONFIG, AUTO)
    rig = replace(rig, fitted=replace(rig.fitted, fixed=False))
    (line,) = rig.warnings()
    assert "stabilised" in line
    assert rig.figures().to_json()["fixed"] is False
    known = KnownRig(rig.given, rig.calibration, rig.fitted, "first")
    assert known.begun(CONFIG.rectification).warnings() == []


@pytest.mark.parametrize(
    ("short", "live", "refine"),
    [(True, False, True), (False, True, True), (True, False, False)],
    ids=["too short", "live", "off"],
)
def test_what_is_not_to_be_refined_is_read_once_and_not_matched(street, *, short, live, refine):
    read: list[int] = []

    def noted(index: int) -> StereoPair:
        read.append(index)
        return street.pairs[0]

    source: StereoSource = faults.Spoiled(street.calibration, FRAMES, noted)
    source = SourcePart(source, 1, FRAMES) if short else source
    source = LiveSource(source) if live else source
    rig = refine_rig(source, CONFIG, RigSettings(refine=refine))
    assert (rig.refined, rig.fitted, rig.figures().to_json()) == (False, None, {"refined": False})
    assert (rig.warnings(), rig.wrong_at(10.0)) == ([], False)
    assert rig.applied(source) is source
    assert len(read) == len(set(read)) == (0 if live else len(source))


@pytest.mark.parametrize("drive", ["black", "standing still"])
def test_a_drive_that_shows_nothing_keeps_its_calibration(street, drive):
    black = street.taken(slice(None), np.zeros_like)
    still = Film(FRAMES * street.pairs[:1], street.calibration, street.trajectory.T_world_camera)
    rig = refine_rig({"black": black, "standing still": still}[drive], CONFIG, AUTO)
    assert (rig.refined, rig.figures().to_json()) == (False, {"refined": False})


@pytest.mark.slow
@pytest.mark.parametrize("drive", ["far things", "turning on the spot"])
def test_nothing_is_invented_where_motion_shows_little(drive):
    baseline_m = 0.1 if drive == "far things" else 0.54
    world = build_street(StreetScene(frames=FRAMES, seed=3, baseline_m=baseline_m, **SIZE))
    if drive == "turning on the spot":
        turns = [
            make_transform(exp_so3(np.array([0, 0.035 * k, 0])), np.zeros(3)) for k in range(FRAMES)
        ]
        world = replace(world, T_street_camera=world.T_street_camera[0] @ np.stack(turns))
    camera, poses = StreetCamera(world), world.trajectory.T_world_camera
    seen = Film([camera.pair(k) for k in range(FRAMES)], world.camera, poses)
    rig = refine_rig(seen, CONFIG, AUTO)
    assert off(world.camera, rig.calibration).moved_px <= 0.05
    # Of how long the path is, little is known, and that is said.
    assert rig.length_ratio is None or rig.length_ratio > 0.02


def test_depth_behind_infinity_is_said_and_can_be_stored(street):
    camera = street.calibration
    true = turned_rig(camera, yaw_deg=2.0)
    changes = tuple(compare_rigs(camera, true, z, CONFIG.rectification) for z in (10.0, 30.0))
    fitted = refine_rig(street, CONFIG, AUTO).fitted
    rig = RefinedRig(camera, true, camera, fitted, changes=changes, sigma_px=0.1)
    assert rig.depth_percent(changes[1]) == (np.inf, np.inf)
    assert json.loads(json.dumps(rig.figures().to_json(), allow_nan=False))["depth_percent"][
        "30"
    ] == {
        "mean": None,
        "sigma": None,
    }
    assert "px rms over the image, depth up to behind infinity" in rig.describe(30.0)
    assert rig.wrong_at(10.0)
    # Less than two standard deviations are no fault.
    assert not replace(rig, sigma_px=10.0).wrong_at(10.0)


def test_known_poses_are_those_of_the_refined_rig(street):
    camera = street.calibration
    refined = turned_rig(camera, pitch_deg=1.0)
    rig = RefinedRig(camera, refined, camera)
    T = make_transform(exp_so3(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
    given = Trajectory(np.stack([np.eye(4), T]), np.array([0.0, 0.1]))
    found = rig.poses(given, CONFIG.rectification).T_world_camera
    R = turns_of(refined, CONFIG.rectification).R_left
    assert np.degrees(np.arccos((np.trace(R) - 1) / 2)) == pytest.approx(0.5, abs=0.01)
    # The raw left camera is where it was.
    np.testing.assert_allclose(found[:, :3, :3] @ R, given.T_world_camera[:, :3, :3], atol=1e-12)
    np.testing.assert_array_equal(found[:, :3, 3], given.T_world_camera[:, :3, 3])
    # The true path of a source is that of one or the other.
    source = Plain()
    assert rig.true_path(source, CONFIG.rectification) is None
    for before, of_raw in ((refined, True), (camera, False)):
        vars(source).update(truth=SequenceTruth(given), truth_of_raw=of_raw)
        true = replace(rig, given=before).true_path(source, CONFIG.rectification)
        np.testing.assert_array_equal(true.T_world_camera, found)


class Plain(StereoSource):
    def __len__(self) -> int:
        return 0

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        return iter(())

    @property
    def calibration(self) -> Rig:
        return GIVEN


GIVEN = RectifiedCamera(200.0, 99.5, 49.5, 99.5, 0.5, 200, 100)
