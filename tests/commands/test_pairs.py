"""Pairs from Python and from files: any matcher, any calibration, or none."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import recon
from recon.commands.config import PAIR_DEFAULTS, load_config
from recon.commands.pair import run_pair
from recon.core.errors import CalibrationError, FormatError, ReconError, SettingsError
from recon.core.values import RectifiedCamera, StereoPair
from recon.io.images.image import write_image
from recon.sources.one_pair import PairInput, read_pair_input
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from tests.sources.test_drives import ALL

pytestmark = pytest.mark.usefixtures("blank_figures")


@pytest.fixture(scope="module")
def noise():
    """Noise, six pixels further left in the right image."""
    world = np.random.default_rng(8).integers(0, 256, (50, 130), dtype=np.uint8)
    world = cv2.GaussianBlur(world, (3, 3), 0)
    return world[:, :120], world[:, 6:126]


def test_settings_are_those_of_the_matcher_that_is_named(noise):
    assert recon.match(*noise, matcher="opencv-bm", window_px=15).values.shape == (50, 120)
    with pytest.raises(SettingsError, match="unknown setting 'matching"):
        recon.match(*noise, matcher="fine", window_px=15)
    with pytest.raises(SettingsError, match="unknown matcher"):
        recon.match(*noise, matcher="nonsense")


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        (["matching.window_px=9", "matching.opencv.pad=true"], ["window_px", "opencv"]),
        (["matching.fill=false", "matching.ndisp=32"], []),
        (["matching.matcher=sad", "matching.window_px=9"], []),
    ],
)
def test_settings_of_a_matcher_that_is_not_used_are_said_to_have_no_effect(noise, changes, named):
    config = load_config(None, changes, PAIR_DEFAULTS)
    given = PairInput(StereoPair(*noise), recon.RectifiedCamera(100.0, 60, 25, 60, 0.1, 120, 50))
    found = recon.run_disparity(given, config)
    said = [text for text in found.warnings if "has no effect" in text]
    assert [text.split()[0] for text in said] == [f"matching.{name}" for name in named]


CALIBRATIONS = {
    "kitti": "P0: 100 0 60 0 0 100 25 0 0 0 1 0\nP1: 100 0 60 -50 0 100 25 0 0 0 1 0\n",
    "middlebury": "cam0=[100 0 60; 0 100 25; 0 0 1]\ncam1=[100 0 60; 0 100 25; 0 0 1]\n"
    "doffs=0\nbaseline=500\nwidth=120\nheight=50\nndisp=16\n",
}


@pytest.mark.parametrize("kind", CALIBRATIONS)
def test_a_calibration_file_gives_metres_and_may_need_the_size_of_images(noise, tmp_path, kind):
    path, size = tmp_path / "calib.txt", (120, 50)
    path.write_text(CALIBRATIONS[kind])
    frame = recon.reconstruct(*noise, path)
    # f·b / d = 100 · 0.5 / 6; a quarter of a pixel off, as above, is 4 % of the disparity.
    assert np.median(frame.cloud.xyz[:, 2]) == pytest.approx(100 * 0.5 / 6, rel=0.05)
    assert recon.read_calibration(path, *size).baseline_m == pytest.approx(0.5)
    if kind == "middlebury":  # which has the size
        assert recon.read_calibration(path).baseline_m == pytest.approx(0.5)
    else:
        with pytest.raises(FormatError, match="pass width_px and height_px"):
            recon.read_calibration(path)


@pytest.fixture
def images(tmp_path):
    """Blurred noise, 12 pixels further left in the right image."""
    world = np.random.default_rng(3).integers(0, 256, (120, 260)).astype(np.uint8)
    world = cv2.GaussianBlur(world, (0, 0), 1.5).astype(np.float64)
    grey = np.uint8(255 * (world - world.min()) / np.ptp(world))
    write_image(tmp_path / "left.png", grey[:, :240])
    write_image(tmp_path / "right.png", grey[:, 12:252])
    return tmp_path / "left.png", tmp_path / "right.png"


def read(images: tuple[Path, Path], known: SourceSettings) -> PairInput:
    return read_pair_input(*images, None, known=known)


def test_focal_length_and_baseline_give_metres_and_a_principal_point_is_that_of_both_views(images):
    given = read(images, SourceSettings(focal_px=300, baseline_m=0.2))
    camera = given.calibration
    assert (camera.focal_px, camera.baseline_m) == (300, 0.2)
    assert (camera.cx_px, camera.cy_px, camera.doffs_px) == (119.5, 59.5, 0)
    assert (given.notes, given.up_to_scale) == ((), False)
    known = SourceSettings(focal_px=300, baseline_m=0.2, cx_px=100, cy_px=50)
    camera = read(images, known).calibration
    assert (camera.cx_px, camera.cy_px, camera.cx_right_px) == (100, 50, 100)


def test_without_a_baseline_the_cloud_is_up_to_scale_and_says_so(images, tmp_path):
    given = read(images, SourceSettings(focal_px=300))
    settings = load_config(None, ["mesh.depth=5"], PAIR_DEFAULTS)
    run = run_pair(given, settings, out=tmp_path / "out")
    assert run.summary.to_json()["up_to_scale"] is True
    assert run.summary.to_json()["depth_median_m"] == pytest.approx(
        300 / 12, rel=0.01
    )  # in baselines
    assert [text for text in run.warnings if "in baselines, not in metres" in text]


def test_pixels_without_a_match_are_in_every_file_what_the_pages_say(images, tmp_path):
    settings = load_config(None, ["matching.fill=false"], PAIR_DEFAULTS)
    out = tmp_path / "out"
    run_pair(read(images, SourceSettings(focal_px=300, baseline_m=0.2)), settings, out=out)

    def stored(name: str) -> np.ndarray:
        content = (out / "disparity" / name).read_bytes()
        return np.frombuffer(content[-4 * 120 * 240 :], "<f4").reshape(120, 240)[::-1]

    levels, reason = (
        cv2.imread(str(out / "disparity" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        for name in ("disparity", "reason")
    )
    holes = reason != 0
    assert 0.01 < holes.mean() < 0.5
    for name in ("disparity.pfm", "depth.pfm"):
        np.testing.assert_array_equal(stored(name) == np.inf, holes)
        assert np.isfinite(stored(name)[~holes]).all()
        read_back = recon.read_pfm(out / "disparity" / name)
        np.testing.assert_array_equal(np.isnan(read_back), holes)
    np.testing.assert_array_equal(stored("confidence.pfm") == 0, holes)
    np.testing.assert_array_equal(levels == 0, holes)


@pytest.mark.parametrize(
    ("known", "message"),
    [
        ({}, r"left\.png: focal length is unknown.*--focal PX"),
        ({"focal_px": 4.5}, r"--focal: .*4\.5 px.*see 17\d deg.*in pixels"),
    ],
)
def test_an_unknown_focal_length_or_one_in_millimetres_is_refused(images, known, message):
    with pytest.raises(CalibrationError, match=message):
        read(images, SourceSettings(baseline_m=0.2, **known))


LAYOUTS = ("folders", "kitti", "kitti-raw", "euroc", "tum", "two videos", "mcap")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_numbers_take_the_place_of_the_calibration_of_every_layout(tmp_path, layout):
    grey = [np.full((32, 64), 10 * k, np.uint8) for k in range(4)]
    pairs = [StereoPair(image, image, 0.1 * k, k) for k, image in enumerate(grey)]
    path = ALL[layout](pairs, RectifiedCamera(60.0, 31.5, 15.5, 31.5, 0.5, 64, 32), tmp_path)
    numbers = SourceSettings(focal_px=50, baseline_m=0.1, cx_px=30)
    camera = open_source(path, settings=numbers).calibration
    assert (camera.focal_px, camera.baseline_m, camera.cx_px) == (50, 0.1, 30)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({}, r"calibration is missing.*--focal PX and --baseline M"),
        ({"focal_px": 300}, r"needs focal length and baseline \(got focal_px=300"),
        ({"baseline_m": 0.1}, r"needs focal length and baseline"),
        ({"focal_px": 300, "baseline_m": 0.1, "calibration": "rig.yaml"}, r"--calib: .*replace"),
    ],
)
def test_half_a_camera_or_two_of_them_are_refused(images, given, said):
    with pytest.raises(ReconError, match=said):
        open_source(images[0].parent, settings=SourceSettings(**given))
