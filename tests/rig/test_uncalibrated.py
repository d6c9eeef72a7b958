import sys

import cv2
import numpy as np
import pytest

from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import exp_so3
from recon.io.middlebury import read_middlebury_scene
from recon.rig.uncalibrated import rectify_features, rectify_images
from recon.stereo.rectify.features import PairFeatures, map_pixels, match_exactly
from recon.stereo.rectify.lens import epipolar_lines
from recon.stereo.rectify.rectifier import to_grey

SIZE = (640, 480)
K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
SLOW = pytest.mark.slow
Three = tuple[float, float, float]


BASE, TURN = (-0.15, 0.01, 0.02), (0.03, -0.05, 0.04)


def scene(shift=BASE, turn=TURN, sigma_px=0.0, *, count=500, flat=False):
    """Points before two pinholes that are turned against each other, which both images show."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform((-2, -1.5, 2), (2, 1.5, 8), (count, 3))
    if flat:
        xyz[:, 2] = 4 + 0.3 * xyz[:, 0]
    views = [p @ K.T for p in (xyz, xyz @ exp_so3(np.array(turn)).T + shift)]
    both = [p[:, :2] / p[:, 2:] + rng.normal(0, sigma_px, (count, 2)) for p in views]
    seen = np.all([(p > 0).all(axis=1) & (p < SIZE).all(axis=1) for p in both], axis=0)
    return PairFeatures(*(p[seen].astype(np.float32) for p in both))


# The first three have their epipoles at infinity, or nearly: rows correspond as they are. The next
# one is but pitched, for which its images are turned as by a lens of a usual focal length.
RIGS = [
    ((0.0, 0.0, 0.0), (-0.1, 0.0, 0.0), 0.01),
    ((1e-9, 0.0, 0.0), (-0.1, 1e-9, -1e-10), 0.01),
    ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), 0.01),
    ((0.02, 0.0, 0.0), (-0.1, 0.0, 0.0), 0.1),
    (TURN, BASE, 0.01),
    ((-0.05, 0.1, -0.1), (-0.15, -0.03, -0.04), 0.01),
]


@pytest.mark.parametrize(("turn", "shift", "exact_px"), RIGS)
@pytest.mark.parametrize("sigma_px", [0.0, 0.3])
def test_rows_are_off_by_no_more_than_noise(turn, shift, exact_px, sigma_px):
    found, truth = rectify_features([scene(shift, turn, sigma_px)], SIZE), scene(shift, turn)
    uv = map_pixels(found.H_left, truth.left_uv), map_pixels(found.H_right, truth.right_uv)
    assert np.abs(uv[0][:, 1] - uv[1][:, 1]).mean() < exact_px + 0.3 * sigma_px
    # Rows of both images are noisy: mean |N(0, 0.3 sqrt 2)|.
    assert found.epipolar_error_held_out_px == pytest.approx(1.13 * sigma_px, rel=0.3, abs=exact_px)
    assert found.inliers > 0.95 * found.matches
    # Of the size of the recorded ones, whichever camera is the left one.
    assert np.ptp(uv[1][:, 1]) == pytest.approx(np.ptp(truth.right_uv[:, 1]), rel=0.25)


def test_wrong_matches_do_no_harm():
    good, truth = scene(sigma_px=0.2), scene()
    rng = np.random.default_rng(1)
    wrong = rng.permutation(len(good))[: len(good) // 4]
    right = good.right_uv.copy()
    right[wrong] = rng.uniform(0, SIZE, (len(wrong), 2))
    found = rectify_features([PairFeatures(good.left_uv, right)], SIZE)
    uv = map_pixels(found.H_left, truth.left_uv), map_pixels(found.H_right, truth.right_uv)
    assert np.abs(uv[0][:, 1] - uv[1][:, 1]).mean() < 0.15


def test_epipolar_lines_pass_through_partners_and_images_stay_upright_in_size():
    features = scene()
    found = rectify_features([features], SIZE)
    left, right = (uv[:5].astype(float) for uv in (features.left_uv, features.right_uv))
    in_left, in_right = epipolar_lines(found.fundamental, left, right, SIZE)
    for pixels, lines in ((left, in_left), (right, in_right)):
        for pixel, line in zip(pixels, lines, strict=True):
            inside = line[np.isfinite(line).all(axis=1)]
            a, b = inside[0], inside[-1]
            across = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
            assert abs((pixel - a) @ across) < 0.1
    found = rectify_features([scene()], SIZE)
    for H in (found.H_left, found.H_right):
        corners = map_pixels(H, np.array([[0.0, 0], [639, 0], [639, 479], [0, 479]]))
        assert corners[0, 0] < corners[1, 0]
        assert corners[0, 1] < corners[3, 1]
        area = 0.5 * abs(np.linalg.det(corners[[2, 1]] - corners[[0, 3]]))
        assert area == pytest.approx(640 * 480, rel=0.25)
    assert found.disparity_range_px[0] == pytest.approx(4.0, abs=0.5)
    assert found.disparity_range_px[1] > 20


FLAT = scene(turn=(0.1, -0.3, 0.1), flat=True, sigma_px=0.1)
AHEAD = scene((0.01, 0.0, -0.5), turn=(0, 0, 0))
ANYTHING = PairFeatures(*np.random.default_rng(2).uniform(0, SIZE, (2, 100, 2)).astype(np.float32))


@pytest.mark.parametrize(
    ("features", "message"),
    [
        (FLAT, r"scene is flat.*100 % of the matches"),
        (AHEAD, r"sees the other camera.*side by side"),
        (scene(count=30), r"too few matched features.*at least 40"),
        (ANYTHING, ""),
    ],
)
def test_matches_without_a_geometry_are_refused(features, message):
    with pytest.raises(CalibrationError, match=message):
        rectify_features([features], SIZE)


def image_of(seed: int, size: tuple[int, int]) -> np.ndarray:
    """A texture with detail of many sizes."""
    rng, total = np.random.default_rng(seed), np.zeros(size[::-1])
    for sigma in (1.0, 2.0, 4.0):
        noise = cv2.GaussianBlur(rng.normal(size=size[::-1]), (0, 0), sigma)
        total += noise / noise.std()
    return np.clip(128 + 30 * total, 0, 255).astype(np.uint8)


def test_exact_features_know_places_to_a_third_of_a_pixel_under_a_homography():
    image = image_of(5, (320, 240))
    H = np.array([[1.05, 0.08, -9], [-0.05, 0.97, 6], [1e-4, -5e-5, 1]])
    warped = cv2.warpPerspective(image, H, (320, 240), flags=cv2.INTER_CUBIC)
    found = match_exactly(image, warped)
    apart = np.linalg.norm(map_pixels(H, found.left_uv) - found.right_uv, axis=1)
    assert len(found) > 100
    assert np.median(apart) < 0.33
    blank = np.full((100, 100), 90, np.uint8)
    assert len(match_exactly(blank, blank)) == 0


def planes_pair(size: tuple[int, int], seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A rectified pair: three upright planes at different depths; and its disparity."""
    width, height = size
    disparity = np.zeros((height, width))
    for n, values in enumerate(((30.0, 10.0), (14.0, 14.0), (6.0, 24.0))):
        rows = slice(n * height // 3, (n + 1) * height // 3)
        disparity[rows] = np.linspace(*values, width)[None]
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    right = image_of(seed, (width + 80, height))[:, 40:-40]
    at = (u - disparity).astype(np.float32)
    return cv2.remap(right, at, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT), right, disparity


def true_rows(found, A: np.ndarray, B: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Row of each pixel less that of its true partner, after both warps and the rectification."""
    v, u = np.nonzero(np.isfinite(disparity))
    left = map_pixels(found.H_left @ A, np.stack([u, v], axis=1))
    right = map_pixels(found.H_right @ B, np.stack([u - disparity[v, u], v], axis=1))
    return np.asarray(left[:, 1] - right[:, 1])


def shaken(size: tuple[int, int], reach: float, rng: np.random.Generator) -> np.ndarray:
    """A homography that moves each corner by up to a fraction of the width."""
    width, height = size
    border = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = border + rng.uniform(-reach, reach, (4, 2)) * width
    return np.asarray(cv2.getPerspectiveTransform(border, moved.astype(np.float32)))


@pytest.mark.parametrize("warp", ["none", "turned", "shifted", "weak", "strong"])
def test_a_pair_under_known_homographies_comes_back_onto_rows(warp):
    size, rng = (400, 300), np.random.default_rng(7)
    left, right, disparity = planes_pair(size)
    turn = np.vstack([cv2.getRotationMatrix2D((200, 150), 2.0, 1.0), [0, 0, 1]])
    A, B = {
        "none": (np.eye(3), np.eye(3)),
        "turned": (np.eye(3), turn),
        "shifted": (np.eye(3), np.array([[1.0, 0, 3], [0, 1, 9], [0, 0, 1]])),
        "weak": (shaken(size, 0.02, rng), shaken(size, 0.02, rng)),
        "strong": (shaken(size, 0.1, rng), shaken(size, 0.1, rng)),
    }[warp]
    seen = tuple(cv2.warpPerspective(p, H, size) for p, H in ((left, A), (right, B)))
    found = rectify_images([seen], count=1500)
    rows = true_rows(found, A, B, disparity)
    assert np.abs(rows).mean() < 0.3


def pitched_folder(pitch_deg: float) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """Eight pairs of a rig whose right camera is pitched, and the homography of that pitch."""
    size, K = (400, 300), np.array([[400.0, 0, 199.5], [0, 400, 149.5], [0, 0, 1]])
    B = K @ exp_so3(np.array([np.deg2rad(pitch_deg), 0, 0])) @ np.linalg.inv(K)
    pairs = [planes_pair(size, seed)[:2] for seed in range(8)]
    if pitch_deg:
        pairs = [(left, cv2.warpPerspective(right, B, size)) for left, right in pairs]
    return pairs, B


@pytest.mark.parametrize("first", ["like the others", "blank", "misleading"])
def test_a_pitched_right_camera_is_turned_back_and_nothing_else(first):
    pairs, B = pitched_folder(0.44)
    if first == "blank":
        pairs[0] = (np.full_like(pairs[0][0], 90),) * 2
    if first == "misleading":  # what moves across the view, as a car that is all that has texture
        oblique = np.array([[1.0, 0, -20], [0, 1, 12], [0, 0, 1]])
        pairs[0] = (pairs[0][0], cv2.warpPerspective(pairs[0][0], oblique, (400, 300)))
    found = rectify_images(pairs, count=600)
    assert (found.model, found.epipolar_error_before_px) == (
        "rotation",
        pytest.approx(3.1, abs=0.4),
    )
    _, _, disparity = planes_pair((400, 300))
    assert np.abs(true_rows(found, np.eye(3), B, disparity)).max() < 0.3
    for H in (found.H_left, found.H_right):
        across = np.diff(map_pixels(H, np.array([[0.0, 150], [399, 150]])), axis=0)[0]
        assert abs(np.degrees(np.arctan2(across[1], across[0]))) < 0.1


def test_pairs_on_equal_rows_stay_as_they_are():
    found = rectify_images(pitched_folder(0.0)[0], count=600)
    assert found.model == "raw"
    assert np.array_equal(found.H_left, np.eye(3))
    assert np.array_equal(found.H_right, np.eye(3))
    assert found.epipolar_error_after_px == found.epipolar_error_before_px


@pytest.mark.real
@pytest.mark.parametrize("reach", [0.06, *(pytest.param(k, marks=SLOW) for k in (0.0, 0.12))])
@pytest.mark.parametrize(
    "name", ["Motorcycle", *(pytest.param(k, marks=SLOW) for k in ("Jadeplant", "Pipes", "Teddy"))]
)
def test_warped_middlebury_pairs_come_back_onto_rows_by_their_truth(recon_data, name, reach):
    found = read_middlebury_scene(recon_data / "middlebury" / "MiddEval3" / "trainingQ" / name)
    left, right = to_grey(found.pair.left), to_grey(found.pair.right)
    size, rng = left.shape[::-1], np.random.default_rng(3)
    A, B = shaken(size, reach, rng), shaken(size, reach, rng)
    seen = tuple(cv2.warpPerspective(p, H, size) for p, H in ((left, A), (right, B)))
    rows = true_rows(rectify_images([seen]), A, B, found.truth.values)
    sys.stdout.write(f"{name} by {reach}: mean epipolar error {np.abs(rows).mean():.3f} px\n")
    # Motorcycle and Pipes are 0.3 px off as they are published.
    assert np.abs(rows).mean() <= 0.7
