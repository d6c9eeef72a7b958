"""A rig comes back from images of every kind of board, by `recon calibrate`."""

import math

import pytest

from recon.commands.cameras import run_calibrate
from recon.commands.config import load_config
from recon.core.values.board import parse_board
from recon.io.cameras.calibration import read_calibration
from recon.io.images.image import write_image
from tests.scenery.boards import board_rig, place_boards, render_views

pytestmark = pytest.mark.usefixtures("blank_figures")


@pytest.mark.parametrize(
    "text",
    [
        "aprilgrid:4x3:60mm:0.3",
        pytest.param("aprilgrid:6x6:36mm:0.3", marks=pytest.mark.slow),
        pytest.param("circles:7x6:30mm:14mm", marks=pytest.mark.slow),
        pytest.param("acircles:4x9:20mm:14mm", marks=pytest.mark.slow),
    ],
)
def test_baseline_and_focal_length_are_within_the_stated_intervals(tmp_path, text):
    rig, board = board_rig(), parse_board(text)
    pictures = render_views(rig, board, place_boards(rig, board, 10, seed=4))
    for number, pair in enumerate(pictures):
        for side, image in zip(("left", "right"), pair, strict=True):
            write_image(tmp_path / side / f"{number:02d}.png", image)
    sides = [str(tmp_path / side) for side in ("left", "right")]
    files = {"file": tmp_path / "rig.yaml", "out": tmp_path / "out"}
    found = run_calibrate(*sides, board, load_config(), threads=1, **files).summary.to_json()
    assert found["views_used"] >= 8
    assert found["stereo_rms_px"] < 0.15
    # 95 % intervals of ten views: the truth is at most half as far out again.
    for name, truth in (("baseline_m", rig.baseline_m), ("focal_px", rig.left.matrix[0, 0])):
        low, high = found[name.replace("_", "_interval_")]
        assert abs(math.log(truth / found[name])) < 0.005
        assert low - (high - low) / 4 < truth < high + (high - low) / 4
    assert found["verdict"] in ("good", "usable")  # ten views are few
    read = read_calibration(files["file"], 640, 480)
    assert read.baseline_m == pytest.approx(rig.baseline_m, rel=0.005)
