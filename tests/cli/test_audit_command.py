"""`recon audit` on the command line: table, JSON, corrected calibration, one line for bad input."""

import json
from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

from recon.cli import app
from recon.core.values import RectifiedCamera, StereoPair
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from tests.look import faults
from tests.sources import drives

pytestmark = pytest.mark.usefixtures("blank_figures")
Drive = tuple[list[StereoPair], RectifiedCamera]
FRAMES = 6


@pytest.fixture(scope="module")
def drive():
    return drives.rendered(FRAMES, width_px=400, height_px=136, focal_px=225.0, seed=5)


@pytest.fixture(scope="module")
def good(drive, tmp_path_factory):
    return drives.write_kitti(*drive, tmp_path_factory.mktemp("good"))


def recon(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def spoiled(drive: Drive, **turn_deg: float) -> Drive:
    pairs, camera = drive
    source = faults.Spoiled(camera, len(pairs), pairs.__getitem__)
    return list(faults.turned(source, **turn_deg)), camera


def test_a_good_drive_is_announced_measured_and_found_good(good, tmp_path):
    done = recon("audit", good, "--source", "kitti", "--verbose", "--out", tmp_path / "audited")
    assert done.exit_code == 0
    assert '"description": "KITTI odometry drive' in done.stderr
    for words in (
        "is good",
        "epipolar_error_rms_px",
        "sharpness_left",
        "depth_error_m.10",
        "0.540 m",
    ):
        assert words in done.stdout
    page = (tmp_path / "audited" / "report.html").read_text()
    for words in ("Verdict: good", "Epipolar errors", "Disparity", "Exposure, focus"):
        assert words in page
    summary = json.loads((tmp_path / "audited" / "summary.json").read_text())
    assert summary["verdict"] == "good"


def test_what_is_to_be_known_of_the_source_is_printed_too(drive, tmp_path):
    path = drives.write_kitti(*drive, tmp_path)
    (path / "image_1" / "000002.png").unlink()
    done = recon("audit", path)
    assert "warning: 1 image without a partner: left out\n" in done.stderr


def test_a_layout_that_is_named_and_not_there_is_refused(good):
    done = recon("audit", good, "--source", "euroc")
    assert done.exit_code == 1
    assert "cam0: folder of a camera is missing" in done.stderr


def test_json_has_the_verdict_and_nothing_else_is_printed(drive, tmp_path):
    path = drives.write_kitti(*spoiled(drive, roll_deg=1.0), tmp_path)
    done = recon("audit", path, "--json", "--quiet")
    summary = json.loads(done.stdout)
    assert done.exit_code == 0
    assert summary["verdict"] == "not usable"
    assert [finding["code"] for finding in summary["findings"]] == ["rows"]
    assert summary["findings"][0]["severity"] == "fatal"
    assert summary["repair_roll_deg"] == pytest.approx(-1, abs=0.1)
    assert summary["frames"] == summary["frames_read"] == FRAMES
    fb = drive[1].focal_px * drive[1].baseline_m
    far_m, near_m = (fb / summary["disparity_5_50_95_px"][end] for end in (0, 2))
    depths_m = [float(each) for each in summary["depth_error_m"]]
    assert near_m / 2 < depths_m[0] < 2 * near_m
    assert far_m / 2 < depths_m[-1] < 2 * far_m


def test_what_it_mends_is_a_calibration_that_makes_the_drive_good(drive, tmp_path):
    path = drives.write_kitti(*spoiled(drive, pitch_deg=0.3), tmp_path / "drive")
    repaired = tmp_path / "repaired.yaml"
    told = recon("audit", path, "--repair", repaired, "--json", "--quiet")
    assert json.loads(told.stdout)["repaired"]["calibration"] == str(repaired)
    again = json.loads(recon("audit", path, "--calib", repaired, "--json", "--quiet").stdout)
    assert again["verdict"] == "good"
    assert abs(again["epipolar_error_mean_px"]) < 0.3
    # The same file is what `recon map --calib` opens the drive with.
    source = open_source(path, settings=SourceSettings(calibration=str(repaired)))
    assert source.calibration.baseline_m == pytest.approx(drive[1].baseline_m)
