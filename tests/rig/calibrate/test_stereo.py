import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import angle_rad, apply
from recon.core.values import StereoCalibration
from recon.rig.calibrate import stereo
from recon.rig.calibrate.bundle import Sighting, View
from recon.rig.calibrate.stereo import (
    Spread,
    StereoFit,
    calibrate_stereo,
    measure_depth,
    measure_spread,
)
from recon.rig.settings import CalibrationSettings
from recon.stereo.rectify.lens import project_raw, rays_of

SIZE = (640, 480)
LENSES = ("radtan", "rational", "fisheye")


def calibrated(views: list[View], **settings: object) -> StereoFit:
    return calibrate_stereo(views, SIZE, CalibrationSettings(**settings))


def spread_of(views: list[View]) -> Spread:
    return measure_spread(calibrated(views), CalibrationSettings())


def assert_rig(fit: StereoFit, want: StereoCalibration, tolerance: float, turn_deg: float) -> None:
    have = fit.calibration
    for ours, theirs in ((have.left, want.left), (have.right, want.right)):
        np.testing.assert_allclose(np.diag(ours.matrix), np.diag(theirs.matrix), rtol=tolerance)
        np.testing.assert_allclose(ours.matrix, theirs.matrix, rtol=3 * tolerance)
    assert have.baseline_m == pytest.approx(want.baseline_m, rel=tolerance)
    turn = angle_rad(have.T_right_left @ np.linalg.inv(want.T_right_left))
    assert float(np.degrees(turn)) < turn_deg


@pytest.mark.parametrize("lens", LENSES)
def test_without_noise_the_true_rig_comes_back(make_views, lens):
    rig, views = make_views(lens, sigma_px=0.0)
    fit = calibrated(views, model=lens)
    # A rational lens is held near zero by as much as 0.1 px would, so it is not quite free.
    assert fit.rms_px < 0.01
    assert_rig(fit, rig, *((2e-3, 0.02) if lens == "rational" else (1e-6, 1e-5)))


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
@pytest.mark.parametrize("lens", LENSES)
def test_with_a_tenth_of_a_pixel_of_noise_the_rig_is_right_within_the_bounds(
    make_views, lens, seed
):
    rig, views = make_views(lens, count=30, seed=seed, board="chess:11x8:20mm")
    fit = calibrated(views, model=lens)
    # Two coordinates of 0.1 px each, less what 200-odd numbers take up of 10560.
    assert fit.rms_px == pytest.approx(0.1414, rel=0.05)
    assert_rig(fit, rig, 0.003, 0.05)
    assert not fit.dropped


def test_the_minimum_is_that_of_opencv(make_views):
    """OpenCV's own solver, from our result, finds nothing better: both minimise the same sum."""
    _, views = make_views(count=12)
    fit = calibrated(views)
    left, right = fit.calibration.left, fit.calibration.right
    rms, K1, _, K2, _, R, T, *_ = cv2.stereoCalibrate(
        [v.seen[0].board_m.astype(np.float32) for v in views],
        *([v.seen[k].pixels.astype(np.float32) for v in views] for k in (0, 1)),
        *(m.copy() for m in (left.matrix, left.distortion, right.matrix, right.distortion)),
        SIZE,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(3, 200, 1e-12),
    )
    assert fit.rms_px == pytest.approx(rms, rel=1e-5)
    # float32 pixels, and OpenCV stops by its own rule: a thousandth of the spread.
    np.testing.assert_allclose(K1, left.matrix, rtol=1e-4)
    np.testing.assert_allclose(K2, right.matrix, rtol=1e-4)
    np.testing.assert_allclose(R, fit.calibration.T_right_left[:3, :3], atol=1e-5)
    np.testing.assert_allclose(T.ravel(), fit.calibration.T_right_left[:3, 3], atol=1e-5)


def spoil(view: View, side: int, sigma_px: float) -> View:
    seen, pixels = list(view.seen), view.seen[side].pixels
    noise = np.random.default_rng(7).normal(0, sigma_px, pixels.shape)
    seen[side] = replace(seen[side], pixels=pixels + noise)
    return replace(view, seen=tuple(seen))


def test_views_that_do_not_fit_are_dropped_and_named(make_views):
    rig, views = make_views(count=15)
    views[3], views[8] = spoil(views[3], 0, 3.0), spoil(views[8], 1, 5.0)
    # A pair of images of different moments: each fits its own camera well.
    views[12] = replace(views[12], seen=(views[12].seen[0], views[11].seen[1]))
    fit = calibrated(views)
    assert sorted(fit.dropped) == ["v03", "v08", "v12"]
    assert min(fit.dropped.values()) > 1
    assert len(fit.views) == len(fit.errors_px) == 12
    assert fit.calibration.left.matrix[0, 0] == pytest.approx(rig.left.matrix[0, 0], rel=0.003)
    clean = calibrated(list(fit.views))
    np.testing.assert_allclose(
        fit.calibration.T_right_left, clean.calibration.T_right_left, atol=1e-7
    )


def test_a_board_seen_in_part_by_either_camera_counts_with_what_is_seen(make_views):
    rig, views = make_views(count=20, board="chess:9x6:25mm")
    rng = np.random.default_rng(4)

    def part(seen: Sighting) -> Sighting:
        kept = np.sort(rng.choice(54, 30, replace=False))
        return Sighting(seen.numbers[kept], seen.board_m[kept], seen.pixels[kept])

    parts = [replace(view, seen=tuple(map(part, view.seen))) for view in views]
    assert_rig(calibrated(parts), rig, 0.005, 0.2)


def test_other_moments_other_lenses_and_too_few_views_are_refused_as_such(make_views, monkeypatch):
    _, views = make_views(count=12)
    shuffled = [
        replace(view, seen=(view.seen[0], views[(n + 5) % 12].seen[1]))
        for n, view in enumerate(views)
    ]
    repeated = again(views[:3], 5, 0.1)
    for given, message in (
        (shuffled, r"alone.*together.*same time"),
        (views[:4], r"too few views.*got 4.*at least 5"),
        (repeated, r"got 3, and 12 that repeat them"),
    ):
        with pytest.raises(CalibrationError, match=message):
            calibrated(given)
    monkeypatch.setattr(stereo, "_MAX_RMS_PX", 0.5)
    with pytest.raises(CalibrationError, match=r"no lens of this model.*--model"):
        calibrated(make_views("fisheye", count=12)[1], radial_terms=2)


def test_depth_is_that_of_the_point_and_judged_where_matching_errs_or_the_user_works(make_views):
    rig, _ = make_views(count=1)
    pixels = np.array([[320.0, 240], [100, 100], [500, 400]])
    xyz = rays_of(rig.left, pixels) * [[2.0], [5.0], [20.0]]
    right = project_raw(rig.right, apply(rig.T_right_left, xyz))
    np.testing.assert_allclose(measure_depth(rig, pixels, right), [2, 5, 20], rtol=1e-8)
    rig, views = make_views(count=10)
    fit = calibrated(views)
    own = measure_spread(fit, CalibrationSettings()).working
    assert own.matching_m == pytest.approx(0.02 * own.depth_m)
    depth_m = 0.02 * rig.left.matrix[0, 0] * rig.baseline_m / 0.25
    assert own.depth_m == pytest.approx(depth_m, rel=0.01)
    asked = measure_spread(fit, CalibrationSettings(working_m=1.5)).working
    assert asked.depth_m == 1.5


def test_the_spread_shrinks_with_noise_and_views_and_grows_with_the_square_of_depth(make_views):
    def width(count: int, sigma_px: float) -> float:
        low, high = spread_of(make_views(count=count, sigma_px=sigma_px)[1]).baseline_m
        return high - low

    wide = width(12, 0.2)
    assert width(12, 0.1) == pytest.approx(wide / 2, rel=0.3)
    assert width(48, 0.2) < 0.7 * wide
    _, views = make_views(count=15)
    spread, other = (spread_of(views) for _ in range(2))
    # Sums of several threads are rounded in any order.
    assert spread.focal_px == pytest.approx(other.focal_px, rel=1e-8)
    assert spread.baseline_m == pytest.approx(other.baseline_m, rel=1e-8)
    near, _, far, _ = spread.depths
    assert far.matching_m == pytest.approx(25 * near.matching_m)
    assert 9 < far.calibration_m / near.calibration_m < 40
    assert near.low_m < 0 < near.high_m


@pytest.mark.slow
@pytest.mark.parametrize("lens", LENSES)
def test_the_intervals_hold_the_truth_in_most_repeats(make_views, lens):
    """At least 85 % of 20 repeats, of focal length, baseline and depth at every distance."""
    settings = CalibrationSettings(model=lens)
    held: dict[str, list[bool]] = {}
    middle = np.array([[320.0, 240.0]])
    for seed in range(20):
        rig, views = make_views(lens, count=20, seed=seed)
        fit = calibrate_stereo(views, SIZE, settings)
        spread = measure_spread(fit, settings)
        truths = {
            "focal": (*spread.focal_px, rig.left.matrix[0, 0]),
            "baseline": (*spread.baseline_m, rig.baseline_m),
        }
        for each in spread.depths:
            xyz = rays_of(rig.left, middle) * each.depth_m
            right = project_raw(rig.right, apply(rig.T_right_left, xyz))
            error = measure_depth(fit.calibration, middle, right)[0] - each.depth_m
            truths[f"{each.depth_m:g} m"] = (each.low_m, each.high_m, error)
        for name, (low, high, truth) in truths.items():
            held.setdefault(name, []).append(bool(low <= truth <= high))
    ratios = {name: float(np.mean(each)) for name, each in held.items()}
    sys.stdout.write(f"{lens}: fraction of intervals that hold the truth: {ratios}\n")
    assert min(ratios.values()) >= 0.85, ratios


def again(views: list[View], times: int, sigma_px: float, seed: int = 9) -> list[View]:
    """Each view captured several times, with noise of the corners that is new each time."""
    rng = np.random.default_rng(seed)

    def noisy(seen: Sighting) -> Sighting:
        return replace(seen, pixels=seen.pixels + rng.normal(0, sigma_px, seen.pixels.shape))

    return [
        View(f"{view.name}-{number}", tuple(map(noisy, view.seen)))
        for view in views
        for number in range(times)
    ]


@pytest.mark.parametrize(
    "fresh_px", [0.05, *(pytest.param(k, marks=pytest.mark.slow) for k in (0.0, 0.5))]
)
def test_views_captured_five_times_do_not_make_the_forecast_better(make_views, fresh_px):
    """Noise of a still board that repeats (0.1 px) and, on top of it, noise that does not."""
    _, views = make_views(count=13)
    once, fit = spread_of(again(views, 1, fresh_px)), calibrated(again(views, 5, fresh_px))
    five = measure_spread(fit, CalibrationSettings())
    assert (len(fit.views), len(fit.repeated)) == (13, 52)
    # Another draw of the fresh noise; a spread from 13 views is itself known to a quarter or so.
    tolerance = 0.5 if fresh_px else 1e-6
    assert five.rotation_deg == pytest.approx(once.rotation_deg, rel=tolerance)
    for one, other in zip(once.depths, five.depths, strict=True):
        assert other.calibration_m == pytest.approx(one.calibration_m, rel=tolerance)


def test_a_board_whose_corners_begin_at_the_other_end_repeats_the_view(make_views):
    _, views = make_views(count=40)
    seen = tuple(replace(seen, pixels=seen.pixels[::-1]) for seen in views[2].seen)
    turned = replace(views[2], name="turned", seen=seen)
    fit = calibrated([*views, turned], radial_terms=2)
    assert fit.repeated == ("turned",)  # and none of those that only resemble each other
    assert fit.calibration.left.distortion.size == 4
