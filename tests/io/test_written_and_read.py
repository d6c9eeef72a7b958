"""What the public writers write, the public readers read back; what they would not is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import recon
from recon.core.errors import CalibrationError, FormatError, OutputError
from recon.core.geometry.se3 import invert
from recon.core.values import FREE, OCCUPIED, UNKNOWN
from recon.io.models.rasters import write_nav2, write_nav2_costs
from recon.io.trajectory import reordered, write_tum
from tests.io.cameras.test_calibrations import rig
from tests.io.test_trajectory_files import STANDING, carried, crabbing, drive

CAMERA = recon.RectifiedCamera(700.0, 600.1, 180.7, 610.3, 0.54, 1242, 375, ndisp=96)
GRID = recon.OccupancyGrid(
    np.array([[FREE, OCCUPIED, UNKNOWN], [OCCUPIED, UNKNOWN, FREE]], np.int8), 0.2, (-3.4, 1.25)
)
ODD = reordered(reordered(reordered(drive())))
"""A path that looks as if its quaternions were in the other order."""
PATHS = [drive(), STANDING, crabbing(1.5), ODD, *map(carried, range(3)), drive().select(slice(1))]


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("form", ["tum", "kitti"])
def test_a_trajectory_is_read_back_whatever_it_is(tmp_path, path, form):
    recon.write_trajectory(tmp_path / "a" / "poses.txt", path, form)
    times_s = path.timestamps_s if form == "kitti" else None
    back = recon.read_trajectory(tmp_path / "a" / "poses.txt", times_s)
    np.testing.assert_allclose(back.T_world_camera, path.T_world_camera, atol=1e-9)
    np.testing.assert_allclose(back.timestamps_s, path.timestamps_s, atol=1e-6)


def test_without_its_first_line_an_odd_path_is_not_believed(tmp_path):
    write_tum(tmp_path / "poses.txt", ODD)
    with pytest.raises(FormatError, match="not in the order of TUM"):
        recon.read_trajectory(tmp_path / "poses.txt")


@pytest.mark.parametrize(
    ("path", "form", "said"),
    [
        (drive(), "euroc", r"unknown format.*euroc.*tum or kitti"),
        (drive().select(slice(0)), "tum", "has no pose"),
    ],
)
def test_a_trajectory_that_nobody_could_read_is_not_written(tmp_path, path, form, said):
    with pytest.raises(OutputError, match=said):
        recon.write_trajectory(tmp_path / "poses.txt", path, form)
    assert not [*tmp_path.iterdir()]


def test_a_calibration_is_read_back_whatever_it_is_called(tmp_path):
    for name in ("calib.txt", "rig.yaml", "K.json"):
        recon.write_calibration(str(tmp_path / name), CAMERA)
        assert recon.read_calibration(tmp_path / name) == CAMERA
    for lens in ("none", "rational", "fisheye"):
        given = rig(lens)
        recon.write_calibration(tmp_path / "rig.yaml", given)
        back = recon.read_calibration(tmp_path / "rig.yaml")
        np.testing.assert_array_equal(back.T_right_left, given.T_right_left)
        np.testing.assert_array_equal(back.left.distortion, given.left.distortion)


def test_a_calibration_that_would_be_refused_is_not_written(tmp_path):
    given = rig("none")
    swapped = recon.StereoCalibration(given.right, given.left, invert(given.T_right_left))
    with pytest.raises(CalibrationError, match=r"rig\.yaml: right camera is to the left"):
        recon.write_calibration(tmp_path / "rig.yaml", swapped)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("write", [recon.write_calibration, recon.write_trajectory])
def test_no_file_replaces_a_folder(tmp_path, write):
    value = CAMERA if write is recon.write_calibration else drive()
    with pytest.raises(OutputError, match="expected a regular file"):
        write(tmp_path, value)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        write(tmp_path / "file" / "below", value)


def described(folder: Path, **changes: object) -> Path:
    _, path = write_nav2(folder / "grid", GRID)
    fields = yaml.safe_load(path.read_text()) | changes
    path.write_text(yaml.safe_dump({k: v for k, v in fields.items() if v != "gone"}))
    return path


def test_a_grid_is_read_back(tmp_path):
    back = recon.read_grid(str(described(tmp_path)))
    np.testing.assert_array_equal(back.cells, GRID.cells)
    assert (back.resolution_m, back.origin_m) == (GRID.resolution_m, GRID.origin_m)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"image": "other.pgm"}, r"other\.pgm: file does not exist"),
        ({"image": "."}, "cannot read the file"),
        ({"image": "grid.yaml"}, "not a binary 8-bit PGM"),
        ({"origin": [0.0, 0.0, 0.3]}, "rotated"),
        ({"origin": [0.0, 0.0]}, "not a number"),
        ({"resolution": "fine"}, "not a number"),
        ({"resolution": "gone"}, "no 'resolution'"),
        ({"mode": "raw"}, "mode of the map"),
    ],
)
def test_a_grid_that_is_damaged_or_of_another_kind_is_refused(tmp_path, changes, said):
    path = described(tmp_path, **changes)
    with pytest.raises(FormatError, match=said):
        recon.read_grid(path)


def test_what_is_no_grid_is_refused(tmp_path):
    _, costs = write_nav2_costs(tmp_path / "costs", GRID)
    (tmp_path / "list.yaml").write_text("- 1\n")
    for path in (costs, tmp_path / "list.yaml", tmp_path, tmp_path / "none.yaml"):
        with pytest.raises(FormatError):
            recon.read_grid(path)
    short = replace(GRID, cells=GRID.cells[:1].copy())
    image, path = write_nav2(tmp_path / "short", short)
    image.write_bytes(image.read_bytes()[:-1])
    with pytest.raises(FormatError, match="truncated"):
        recon.read_grid(path)
