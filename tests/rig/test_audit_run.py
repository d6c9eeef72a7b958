"""The audit finds each injected fault, and nothing in a drive without faults."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import CalibrationError
from recon.core.values import StereoPair
from recon.io.cameras.calibration import read_calibration
from recon.look.findings import find_faults
from recon.look.look import look_at
from recon.rig.audit import audit_source, correct_calibration
from recon.sources.registry import open_source
from recon.sources.source import StereoSource
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.look import faults
from tests.sources import drives

CONFIG = load_config()
FRAMES = 10


def rendered(seed: int, frames: int) -> faults.Spoiled:
    size = {"width_px": 400, "height_px": 136, "focal_px": 225.0}
    scene = StreetScene(seed=seed, frames=frames, threads=1, smooth_edges=False, **size)
    source = SyntheticSource(scene)
    pairs: list[StereoPair] = list(source)
    return faults.Spoiled(source.calibration, len(pairs), pairs.__getitem__)


@pytest.fixture(scope="module")
def street():
    return rendered(5, FRAMES)


def codes(source: StereoSource, *, quick: bool = False) -> set[str]:
    return {finding.code for finding in audit_source(source, CONFIG, quick=quick).findings}


def test_a_clean_drive_is_good_and_its_figures_are_right(street):
    audit = audit_source(street, CONFIG)
    assert (audit.verdict, audit.findings) == ("good", ())
    assert audit.figures.to_json()["gain"] == pytest.approx(1, abs=0.02)
    assert audit.figures.to_json()["epipolar_error_rms_px"] < 0.1
    # 1 m a frame, ten frames a second.
    assert audit.figures.to_json()["speed_m_per_s"] == pytest.approx(10, rel=0.05)
    assert audit.figures.to_json()["frames_read"] == FRAMES
    assert audit_source(street, CONFIG, quick=True).verdict == "good"


@pytest.mark.parametrize("fault", faults.FAULTS)
def test_each_planted_fault_is_found_and_no_other(street, fault):
    code, plant = faults.FAULTS[fault]
    audit = audit_source(plant(street), CONFIG)
    assert [finding.code for finding in audit.findings] == [code]
    assert audit.verdict != "good"
    assert all("\n" not in finding.text for finding in audit.findings)
    if code == "gain":  # OpenCV's matchers get images as they are
        config = load_config(None, ["matching.matcher=opencv-bm"])
        texts = [audit_source(plant(street), c).findings[0].text for c in (CONFIG, config)]
        assert ["evened" in text for text in texts] == [True, False]
    # A quick look finds what spoils every frame.
    assert code in codes(plant(street), quick=True)


@pytest.mark.parametrize("frames", [35, 36])
def test_rows_that_recon_map_corrects_leave_a_drive_usable_and_the_text_says_who_does(
    street, frames
):
    there_and_back = [*range(FRAMES), *range(FRAMES - 2, 0, -1)]
    spoiled = faults.turned(street, roll_deg=1.0)
    longer = replace(
        spoiled,
        count=frames,
        take=lambda index: replace(
            spoiled.take(there_and_back[index % len(there_and_back)]), timestamp_s=0.1 * index
        ),
    )
    audit = audit_source(longer, CONFIG, quick=True)
    (rows,) = (finding for finding in audit.findings if finding.code == "rows")
    assert (audit.verdict, rows.fatal) == (("not usable", True), ("usable", False))[frames == 36]
    assert ("recon map does so" in rows.text) == (frames == 36)
    assert "recon audit --repair FILE writes it" in rows.text


@pytest.mark.parametrize("pitch_deg", [0.3, -0.3])
def test_mending_brings_a_pitch_back_under_a_third_of_a_pixel(street, tmp_path, pitch_deg):
    assert_aligned(faults.turned(street, pitch_deg=pitch_deg, roll_deg=0.2), tmp_path)


def assert_aligned(spoiled: faults.Spoiled, folder: Path) -> None:
    before = audit_source(spoiled, CONFIG)
    assert "rows" in {finding.code for finding in before.findings}
    path = folder / "repaired.yaml"
    correct_calibration(spoiled, CONFIG, before, path)
    height_px, width_px = spoiled.take(0).left.shape[:2]
    repaired = read_calibration(path, width_px, height_px)
    assert repaired.baseline_m == pytest.approx(spoiled.camera.baseline_m, rel=1e-9)
    after = audit_source(replace(spoiled, camera=repaired), CONFIG)
    assert "rows" not in {finding.code for finding in after.findings}
    assert abs(after.figures.to_json()["epipolar_error_mean_px"]) < 0.3
    assert after.figures.to_json()["epipolar_error_rms_px"] < 0.3
    assert (
        before.figures.to_json()["epipolar_error_rms_px"]
        > 5 * after.figures.to_json()["epipolar_error_rms_px"]
    )
    # Mending what is repaired changes next to nothing.
    assert abs(after.figures.to_json()["repair_pitch_deg"]) < 0.02


def test_a_rig_that_is_not_rectified_is_corrected_too(street, tmp_path):
    """Both raw cameras look elsewhere than the rectified ones; the right one is off by 0.3°."""
    left_rad, right_rad = np.radians([[-0.8, 2.0, 0.6], [1.1, -1.5, -0.7]])
    assert codes(faults.unrectified(street, left_rad, right_rad)) == set()
    assert_aligned(faults.unrectified(street, left_rad, right_rad, pitch_deg=0.3), tmp_path)


@pytest.fixture(scope="module")
def longer_street():
    """A drive long enough for its motion to show the rig."""
    return rendered(3, 48)


def test_images_that_are_stabilised_show_no_rig(longer_street, tmp_path):
    look = look_at(longer_street, CONFIG)
    assert look.rig.fitted.fixed
    rig = replace(look.rig, fitted=replace(look.rig.fitted, fixed=False))
    found = find_faults(replace(look, rig=rig), CONFIG)
    assert [(one.code, one.fatal) for one in found] == [("stabilised", False)]
    audit = replace(audit_source(longer_street, CONFIG), findings=found)
    with pytest.raises(CalibrationError, match="moves with what is seen"):
        correct_calibration(longer_street, CONFIG, audit, tmp_path / "repaired.yaml")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("yaw_deg", "enlarged", "pitch_deg"), [(0.25, 1.0, 0.0), (-0.25, 1.005, 0.0), (0.25, 1.0, 0.3)]
)
def test_a_turn_that_only_motion_shows_is_mended(
    longer_street, tmp_path, yaw_deg, enlarged, pitch_deg
):
    spoiled = faults.turned(longer_street, pitch_deg, yaw_deg=yaw_deg, enlarged=enlarged)
    before = audit_source(spoiled, CONFIG)
    assert "rig" in {finding.code for finding in before.findings}
    found = correct_calibration(spoiled, CONFIG, before, tmp_path / "repaired.yaml").to_json()
    assert found["yaw_deg"] == pytest.approx(-yaw_deg, rel=0.25)
    assert found["focal_percent"] == pytest.approx(100 * (enlarged - 1), abs=0.15)
    repaired = read_calibration(tmp_path / "repaired.yaml", 400, 136)
    after = audit_source(replace(spoiled, camera=repaired), CONFIG)
    assert after.findings == ()
    assert after.figures.to_json()["rig_by_motion"]["disparity_px"]["rms"] < 0.1


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize("drive", ["kitti_raw_0013", "kitti_06_51"])
def test_planted_faults_alone_are_found_on_real_drives(recon_data, tmp_path, drive):
    source = open_source(recon_data / "driven" / drive)
    # Lenses of KITTI: 0.6 px over the image. A quick look tracks the same windows.
    assert codes(source) == codes(source, quick=True) == {"rig"}
    for code, plant in faults.FAULTS.values():
        assert code in codes(plant(source))
    assert_aligned(faults.turned(source, pitch_deg=0.3), tmp_path)


@pytest.mark.real
@pytest.mark.parametrize("scene", ["Motorcycle", "Piano", "Playroom", "Recycle", "Teddy"])
def test_nothing_is_found_on_scenes_of_one_pair(recon_data, scene):
    source = open_source(recon_data / "middlebury/MiddEval3/trainingQ" / scene)
    assert audit_source(source, CONFIG).findings == ()


@pytest.mark.real
@pytest.mark.slow
def test_a_turn_planted_in_a_real_drive_is_found(recon_data):
    source = open_source(recon_data / "driven" / "kitti_raw_0013")
    drives_ = (source, faults.turned(source, yaw_deg=0.06))
    yaw_deg = [
        audit_source(drive, CONFIG).figures.to_json()["rig_by_motion"]["yaw_deg"]
        for drive in drives_
    ]
    assert yaw_deg[1] - yaw_deg[0] == pytest.approx(-0.06, rel=0.2)


def test_frames_that_are_missing_are_reported_and_noise_is_no_frozen_camera(street, tmp_path):
    pairs = [street.take(index) for index in (0, 1, 2, 3, 7, 8, 9)]
    pairs = [replace(pair, index=k) for k, pair in enumerate(pairs)]
    grey = [replace(p, left=p.left[:, :, 0], right=p.right[:, :, 0]) for p in pairs]
    source = open_source(drives.write_kitti(grey, faults.rectified(street), tmp_path))
    findings = {finding.code: finding.text for finding in audit_source(source, CONFIG).findings}
    assert "missing at 1 place, at most 0.40 s after frame 3" in findings["gaps"]
    rng = np.random.default_rng(0)
    scene = rng.integers(20, 200, (64, 96))
    pairs = [
        StereoPair(*(np.uint8(scene + rng.normal(0, 1, (2, 64, 96))).clip(0, 255)), 0.1 * k, k)
        for k in range(8)
    ]
    camera = faults.RectifiedCamera(60.0, 47.5, 31.5, 47.5, 0.1, 96, 64)
    found = codes(faults.Spoiled(camera, 8, pairs.__getitem__))
    assert not found & {"frozen", "duplicates"}


def test_a_dark_drive_is_said_with_its_grey_level_and_is_not_fatal(street):
    def dark(index: int) -> StereoPair:
        rng, pair = np.random.default_rng(index), street.take(index)
        left, right = (
            np.clip(np.rint(0.2 * image + rng.normal(0, 1.0, image.shape)), 0, 255).astype(np.uint8)
            for image in (pair.left, pair.right)
        )
        return replace(pair, left=left, right=right)

    findings = audit_source(replace(street, take=dark), CONFIG, quick=True).findings
    (said,) = (finding for finding in findings if finding.code == "dark")
    assert "images of the left and right camera are dark: mean grey level 2" in said.text
    assert not said.fatal


def test_cameras_that_are_late_or_hang_are_measured_and_a_black_image_is_neither(street):
    """Pairs at half speed stand in for skew: every other frame, the right one in between."""

    def half_late(index: int) -> StereoPair:
        return replace(street.take(2 * index), right=street.take(2 * index + 1).right)

    def frozen(index: int) -> StereoPair:
        return replace(street.take(index), right=street.take(min(index, 4)).right)

    def once_black(index: int) -> StereoPair:
        pair = street.take(index)
        return replace(pair, right=np.zeros_like(pair.right)) if index == 4 else pair

    audit = audit_source(faults.Spoiled(street.camera, FRAMES // 2, half_late), CONFIG)
    assert audit.figures.to_json()["time_skew_frames"] == pytest.approx(0.5, abs=0.1)
    assert "skew" in {finding.code for finding in audit.findings}
    findings = audit_source(replace(street, take=frozen), CONFIG).findings
    (hung,) = (finding for finding in findings if finding.code == "frozen")
    assert hung.fatal
    assert "the right camera is frozen for 5 frames" in hung.text
    assert "black" not in codes(replace(street, take=once_black))
    alone = audit_source(replace(street, count=1), CONFIG)
    assert (alone.verdict, alone.figures.to_json()["frames_read"]) == ("good", 1)
    assert alone.figures.to_json()["epipolar_error_rms_px"] < 0.2
