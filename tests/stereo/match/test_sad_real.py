"""The SAD matcher on real images with measured truth (MiddEval3, quarter size)."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.commands.evaluate_middlebury import run_middlebury
from recon.core.values import Disparity, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Float32
from recon.stereo.match.sad import SadMatcher, SadSettings

pytestmark = pytest.mark.real

SCENES = ("ArtL", "Motorcycle", "Piano", "Teddy")


def read_truth(path: Path) -> Float32:
    """The scene's float map, with NaN for unknown; just enough of PFM for these files."""
    kind, size, _scale, pixels = path.read_bytes().split(b"\n", 3)
    assert kind == b"Pf"
    width, height = map(int, size.split())
    values = np.frombuffer(pixels, "<f4").reshape(height, width)[::-1]
    return np.where(np.isfinite(values), values, np.nan).astype(np.float32)


def match_scene(folder: Path) -> tuple[Disparity, Float32]:
    left, right = (cv2.imread(str(folder / f"im{n}.png"), cv2.IMREAD_GRAYSCALE) for n in (0, 1))
    found = re.search(r"ndisp=(\d+)", (folder / "calib.txt").read_text())
    assert found is not None
    height, width = left.shape
    camera = RectifiedCamera(
        focal_px=1000.0,
        cx_px=width / 2,
        cy_px=height / 2,
        cx_right_px=width / 2,
        baseline_m=0.2,
        width_px=width,
        height_px=height,
        ndisp=int(found.group(1)),
    )
    disparity = SadMatcher(SadSettings()).match(RectifiedPair(left, right, camera))
    truth = read_truth(folder / "disp0GT.pfm")
    nonocc = cv2.imread(str(folder / "mask0nocc.png"), cv2.IMREAD_GRAYSCALE) == 255
    return disparity, np.where(nonocc, truth, np.float32(np.nan))


@pytest.fixture(scope="module")
def scenes(recon_data: Path) -> list[tuple[Disparity, Float32]]:
    folder = recon_data / "middlebury" / "MiddEval3" / "trainingQ"
    return [match_scene(folder / name) for name in SCENES]


def pooled(scenes: list[tuple[Disparity, Float32]], name: str) -> np.ndarray:
    """One field of all pixels that have a value and a truth; ``error`` is their error."""
    parts = []
    for disparity, truth in scenes:
        both = disparity.valid & np.isfinite(truth)
        field = disparity.values - truth if name == "error" else getattr(disparity, name)
        parts.append(field[both])
    return np.concatenate(parts)


def test_most_of_what_both_cameras_see_is_matched_and_right(
    scenes: list[tuple[Disparity, Float32]],
) -> None:
    seen = sum(int(np.isfinite(truth).sum()) for _, truth in scenes)
    error = np.abs(pooled(scenes, "error"))
    assert error.size / seen > 0.75
    # Measured: 8 % (all eight scenes, weighted); no local matcher gets below 2 %.
    assert 0.02 < (error > 1).mean() < 0.12
    assert np.median(error) < 0.2


def test_sigma_is_the_spread_of_the_errors(scenes: list[tuple[Disparity, Float32]]) -> None:
    error, sigma = pooled(scenes, "error"), pooled(scenes, "sigma_px")
    ratio = np.abs(error / sigma)
    # A normal distribution has 68 % and 95 %; errors of stereo have heavier tails.
    assert 0.63 < (ratio < 1).mean() < 0.8
    assert 0.86 < (ratio < 2).mean() < 0.97


def test_pixels_of_more_confidence_are_more_often_right(
    scenes: list[tuple[Disparity, Float32]],
) -> None:
    right, confidence = np.abs(pooled(scenes, "error")) < 1, pooled(scenes, "confidence")
    share = [right[(confidence >= a) & (confidence < a + 0.1)].mean() for a in (0.6, 0.7, 0.8, 0.9)]
    assert share == sorted(share)
    assert share[-1] > 0.95


@pytest.fixture(scope="module")
def figures(recon_data: Path, tmp_path_factory: pytest.TempPathFactory) -> dict:
    matchers, out = ("sgm", "opencv-sgbm"), tmp_path_factory.mktemp("real") / "run"
    folder = recon_data / "middlebury" / "MiddEval3" / "trainingQ"
    return run_middlebury(folder, matchers=matchers, out=out)["matchers"]


@pytest.mark.slow
def test_sgm_makes_fewer_and_smaller_errors_than_opencv(figures: dict) -> None:
    ours, other = (figures[m]["weighted"]["nonocc"]["dense"] for m in ("sgm", "opencv-sgbm"))
    # Measured: 0.80, 0.67, 0.53; nothing that is not learned gets far below half.
    assert 0.5 < ours["bad"]["1"] / other["bad"]["1"] <= 0.87
    assert 0.5 < ours["bad"]["2"] / other["bad"]["2"] <= 0.88
    assert 0.4 < ours["avgerr"] / other["avgerr"] <= 0.82
