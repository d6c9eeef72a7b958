"""The drive that shows what length costs goes around and around one block."""

import numpy as np
import pytest

from recon.io.trajectory import read_kitti_poses
from recon.street.path import centre_line
from tests.flow.runs import ROOT


@pytest.fixture(scope="module")
def length():
    """The benchmark as a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "benchmarks")
        import length

        yield length


@pytest.mark.parametrize("frames", [400, 1600])
def test_a_lap_ends_where_it_begins(length, frames):
    street = length.town(frames, 320)
    assert centre_line(street, 0.0).loop_m == pytest.approx(frames * length.STEP_M)


def test_a_drive_repeats_pictures_and_poses_of_its_lap(length, tmp_path):
    lap, drive = tmp_path / "lap", tmp_path / "drive"
    for side in ("image_0", "image_1"):
        (lap / side).mkdir(parents=True)
        for frame in range(3):
            (lap / side / f"{frame:06d}.png").write_text(f"{side} {frame}")
    (lap / "calib.txt").write_text("P0: 1\n")
    rows = [f"1 0 0 {x} 0 1 0 0 0 0 1 0\n" for x in range(3)]
    (lap / "poses.txt").write_text("".join(rows))
    length.go_around(lap, drive, 7)
    seen = [path.read_text() for path in sorted((drive / "image_1").iterdir())]
    assert seen == [f"image_1 {frame}" for frame in (0, 1, 2, 0, 1, 2, 0)]
    poses = read_kitti_poses(drive / "poses.txt").T_world_camera
    np.testing.assert_array_equal(poses[:, 0, 3], [0, 1, 2, 0, 1, 2, 0])


def test_the_time_of_a_frame_is_that_between_frames(length):
    costs = [length.speed.Cost(0.0, used_s) for used_s in (10.0, 10.5, 12.0)]
    assert length.per_frame(costs) == pytest.approx(1.0)


@pytest.mark.parametrize("words", [["0"], ["2000", "--lap", "3"]])
def test_what_is_too_short_to_tell_is_refused(length, capsys, words):
    with pytest.raises(SystemExit):
        length.parse(words)
    assert "20 frames or more" in capsys.readouterr().err
