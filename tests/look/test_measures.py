"""The measures of an audit, each on data with a known answer."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.core.geometry.se3 import exp_so3
from recon.core.values import RectifiedCamera
from recon.look import sample
from recon.look.findings import Finding, verdict_of
from recon.look.sample import QUICK, THOROUGH, plan_windows
from recon.look.tracks import REACH
from recon.stereo.rectify.epipolar import align_epipolar, correct_rig, count_aligned, turn_features
from recon.stereo.rectify.rectifier import shows_texture

CAMERA = RectifiedCamera(500.0, 319.5, 199.5, 330.5, 0.3, 640, 400)


def features(rng, pitch_rad, roll_rad, wrong=0):
    """Features of a right camera that is turned from where rows correspond; some are wrong."""
    left = rng.uniform([20, 20], [620, 380], (400, 2))
    right = left - np.column_stack([rng.uniform(2, 60, 400), np.zeros(400)])
    right[:, 0] += CAMERA.doffs_px
    centre = np.array([CAMERA.cx_right_px, CAMERA.cy_px])
    rays = np.column_stack([(right - centre) / CAMERA.focal_px, np.ones(400)])
    off = rays @ exp_so3(np.array([pitch_rad, 0.0, roll_rad]))
    right = off[:, :2] / off[:, 2:] * CAMERA.focal_px + centre
    right += rng.normal(0, 0.2, right.shape)
    right[:wrong] = rng.uniform([0, 0], [640, 400], (wrong, 2))
    return left.astype(np.float32), right.astype(np.float32)


@settings(max_examples=30)
@given(
    pitch_deg=st.floats(-1.5, 1.5),
    roll_deg=st.floats(-2, 2),
    wrong=st.integers(0, 150),
    seed=st.integers(0, 100),
)
def test_the_turn_that_mends_rows_is_found_among_wrong_matches(pitch_deg, roll_deg, wrong, seed):
    turn = np.radians([pitch_deg, roll_deg])
    left, right = features(np.random.default_rng(seed), *turn, wrong)
    alignment = align_epipolar(left, right, CAMERA)
    # 0.2 px of noise over hundreds of features: a hundredth of a pixel, or 0.002 degrees.
    assert np.degrees(alignment.pitch_rad) == pytest.approx(pitch_deg, abs=0.02)
    assert np.degrees(alignment.roll_rad) == pytest.approx(roll_deg, abs=0.02)
    assert alignment.residual_px == pytest.approx(0.2, abs=0.06)
    assert alignment.agreeing >= 400 - wrong - 4
    assert count_aligned(left, right, CAMERA) >= 0.95 * (400 - wrong)


def test_rows_that_correspond_have_no_error_but_noise_and_few_features_none():
    left, right = features(np.random.default_rng(1), 0.0, 0.0)
    alignment = align_epipolar(left, right, CAMERA)
    assert alignment.rms_px < 0.05  # the noise of 0.2 px is taken away
    assert alignment.spread_px == pytest.approx(0.2, abs=0.03)
    assert align_epipolar(left[:11], right[:11], CAMERA) is None
    assert count_aligned(left[:1], right[:1], CAMERA) == 0


def test_a_mended_rig_projects_to_the_same_rows():
    turn = np.radians([0.5, -0.8])
    left, right = features(np.random.default_rng(3), *turn)
    alignment = align_epipolar(left, right, CAMERA)
    rig = correct_rig(CAMERA, alignment.turn, np.eye(3))
    # Where the repaired calibration says that a point lies is where the turned camera saw it.
    xyz = np.array([[0.4, -0.3, 6.0], [-1.0, 0.8, 9.0], [2.0, 0.1, 20.0]])
    seen = xyz @ rig.T_right_left[:3, :3].T + rig.T_right_left[:3, 3]
    uv = (seen @ rig.right.matrix.T)[:, :2] / seen[:, 2:]
    rows = turn_features(uv.astype(np.float32), CAMERA, turn)[:, 1]
    expected = CAMERA.cy_px + CAMERA.focal_px * xyz[:, 1] / xyz[:, 2]
    np.testing.assert_allclose(rows, expected, atol=0.1)
    assert rig.baseline_m == pytest.approx(CAMERA.baseline_m)


def texture(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    boxes = np.full((300, 400), 90.0)
    for _ in range(200):
        x, y = rng.integers(0, 380), rng.integers(0, 280)
        boxes[y : y + rng.integers(5, 60), x : x + rng.integers(5, 60)] = rng.uniform(30, 150)
    return np.asarray(np.clip(boxes + rng.normal(0, 1, boxes.shape), 0, 255).astype(np.uint8))


def test_sharpness_falls_with_blur_and_not_with_brightness():
    image = texture()
    sharp = sample.measure_sharpness(image)
    blurred = [
        sample.measure_sharpness(cv2.GaussianBlur(image, (0, 0), s)) for s in (0.7, 1.2, 2.0, 3.0)
    ]
    assert sharp > blurred[0] > blurred[1] > blurred[2] > blurred[3]
    dark = cv2.convertScaleAbs(image, alpha=0.5)
    assert sample.measure_sharpness(np.asarray(dark)) == pytest.approx(sharp, abs=0.03)
    assert sample.measure_sharpness(np.full((64, 64), 7, np.uint8)) == 0


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.4, 1.8])
def test_gain_is_measured_although_bright_surfaces_saturate(factor):
    left = cv2.convertScaleAbs(texture(), alpha=1.4)  # up to 210: saturates beyond 1.2
    right = cv2.convertScaleAbs(left, alpha=factor)
    rng = np.random.default_rng(0)
    uv = rng.uniform([10, 10], [390, 290], (500, 2)).astype(np.float32)
    gains = sample.measure_gain(np.asarray(left), np.asarray(right), uv, uv)
    assert np.median(gains) == pytest.approx(factor, rel=0.02)


def test_a_late_camera_is_measured_by_the_rows_that_move():
    rng = np.random.default_rng(0)
    flow = rng.uniform(-12, 12, 2000)
    error = 0.4 * flow + rng.normal(0, 0.3, 2000)
    error[:150] = rng.uniform(-10, 10, 150)
    found = sample.measure_time_skew(error, flow)
    assert found[0] == pytest.approx(0.4, abs=0.01)
    assert abs(found[0] - 0.4) < 5 * found[1] < 0.02
    assert sample.measure_time_skew(error, 0.01 * flow) is None


def test_speed_is_that_of_the_rig_and_scales_with_the_baseline():
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-4, -2, 5), (4, 2, 25), (300, 3))

    def seen(points: np.ndarray, cx_px: float) -> np.ndarray:
        uv = CAMERA.focal_px * points[:, :2] / points[:, 2:] + np.array([cx_px, CAMERA.cy_px])
        return np.asarray(uv, dtype=np.float32)

    left = seen(xyz, CAMERA.cx_px)
    right = seen(xyz - np.array([CAMERA.baseline_m, 0, 0]), CAMERA.cx_right_px)
    later = seen(xyz - np.array([0.1, 0.0, 1.2]), CAMERA.cx_px)
    moved_m = sample.measure_speed(left, right, later, CAMERA)
    assert moved_m == pytest.approx(np.hypot(0.1, 1.2), rel=0.01)
    assert sample.measure_speed(left[:10], right[:10], later[:10], CAMERA) is None


def test_repeats_are_counted_apart_from_frozen_cameras_and_the_worst_finding_decides():
    images = [texture(seed) for seed in range(8)]
    counter = sample.RepeatCounter()
    for left, right in ((0, 0), (1, 0), (2, 0), (3, 0), (4, 4), (4, 4), (5, 5)):
        counter.add(images[left], images[right])
    assert (counter.steps, counter.both, counter.frozen) == (6, 1, [0, 3])
    later = sample.RepeatCounter()
    for _ in range(3):
        later.add(images[5], images[5])
    counter.join(later)
    assert (counter.steps, counter.both, counter.frozen) == (8, 3, [0, 3])
    small, large = Finding("gain", False, "dark"), Finding("rows", True, "off")
    assert verdict_of([]) == "good"
    assert verdict_of([small]) == "usable"
    assert verdict_of([small, large, small]) == "not usable"


@given(frames=st.integers(1, 5000), extent=st.sampled_from([QUICK, THOROUGH]))
def test_what_is_looked_at_lies_within_the_drive(frames, extent):
    windows = plan_windows(frames, extent)
    assert windows[0].start >= 0
    assert windows[-1].stop <= frames
    assert all(before.stop <= after.start for before, after in pairwise(windows))
    assert sum(window.stop - window.start for window in windows) <= extent.frames
    for window in windows:
        assert window.centres
        assert all(window.start <= centre < window.stop for centre in window.centres)
        assert window.start <= window.tracked[0] <= window.tracked[1] <= window.stop
    if extent is QUICK:  # a video is decoded up to each of them
        assert windows[-1].stop <= REACH
    tracked = [window.tracked for window in plan_windows(frames, QUICK)]
    assert [window.tracked for window in windows][: len(tracked)] == tracked
    if frames <= QUICK.frames:
        assert (windows[0].start, windows[-1].stop) == (0, frames)


def test_texture_is_told_from_noise_in_the_dark():
    rng = np.random.default_rng(3)

    def of(detail: np.ndarray, mean: float) -> np.ndarray:
        return np.clip(np.rint(mean + detail), 0, 255).astype(np.uint8)

    noise = [of(rng.normal(0, sigma, (240, 320)), 21) for sigma in (0.2, 1.0, 2.0, 6.0)]
    assert not any(map(shows_texture, noise))
    # As much at every size, as of leaves and gravel, but what a lens blurs.
    sizes = [rng.normal(0, 4.0, (240 // k, 320 // k)).astype(np.float32) for k in (2, 4, 8, 16)]
    texture = sum(cv2.resize(each, (320, 240), interpolation=cv2.INTER_CUBIC) for each in sizes)
    assert shows_texture(of(texture, 21))
    assert shows_texture(np.dstack([of(2 * texture, 90)] * 3))
