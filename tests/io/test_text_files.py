"""Text, tables, YAML, trajectories: what is read is what was written, or meant."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.core.errors import FormatError
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import Trajectory
from recon.io.fields import read_yaml, write_yaml
from recon.io.files import read_table, read_text
from recon.io.imu import read_imu
from recon.io.positions import read_control, read_positions
from recon.io.trajectory import (
    holds_times,
    read_kitti_poses,
    read_trajectory,
    read_tum,
    write_kitti_poses,
    write_tum,
)
from recon.sources.times import read_stamped_names

pytestmark = pytest.mark.portable


def test_tables_and_yaml_are_read_as_they_are_meant(tmp_path):
    path = tmp_path / "t.txt"
    path.write_bytes(b"\xef\xbb\xbf# t x\n1 2\n\n3, 4  # late\n")
    assert read_text(path)[0] == "#"
    table, lines = read_table(path, (2,))
    np.testing.assert_array_equal(table, [[1, 2], [3, 4]])
    assert lines == [2, 4]
    values = {"b": {"window_px": 9, "alpha": None}, "a": [1, 2.5, "größe"]}
    write_yaml(tmp_path / "c.yaml", values)
    assert read_yaml(tmp_path / "c.yaml") == values
    assert list(read_yaml(tmp_path / "c.yaml")) == ["b", "a"]


IMU, GCP = "#t\n" + 9 * "1 0 0 0 0 0 9.8\n", "EPSG:32632\n"
COMMAS = {
    "KITTI": (read_trajectory, "1,0 0,0 0,0 5,5 0,0 1,0 0,0 0,0 0,0 0,0 1,0 0,0\n"),
    "TUM": (read_trajectory, "0.0 0 0 0 0 0 0 1\n1,5 2,0 0,5 0,0 0,0 0,0 0,0 1,0\n"),
    "a quaternion": (read_trajectory, "0,1 1,5 2,0 3,0\n"),
    "a header": (read_tum, "t;x;y;z;qx;qy;qz;qw\n0,1;1,5;2,0;3,0;0,0;0,0;0,0;1,0\n"),
    "positions": (read_positions, "0 1 2 3\n1 1 2 3,5\n"),
    "RTKLIB": (read_positions, "% GPST latitude(deg)\n2020/01/01 00:00:00.000 35,1 139,7 50,1\n"),
    "images": (read_stamped_names, "0.1 a.png\n0,2 b.png\n"),
    "control points": (read_control, GCP + "500000 5000000 400,25 100 200 a.png p1\n"),
    "an inertial unit": (read_imu, IMU + "2 0,1 0,0 0,0 0,0 0,0 9,8\n"),
}


@pytest.mark.parametrize("kind", COMMAS)
def test_a_table_with_decimal_commas_is_refused_for_them(tmp_path, kind):
    read, text = COMMAS[kind]
    (tmp_path / "t.txt").write_text(text)
    line = text.count("\n")
    with pytest.raises(FormatError, match=rf"t\.txt:{line}: decimals are written with a comma"):
        read(tmp_path / "t.txt")


def random_trajectory(seed: int, length: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    # Rotation vectors up to a half turn and beyond: the quaternion's sign and pole are met.
    poses = [
        make_transform(exp_so3(rng.uniform(-np.pi, np.pi, 3)), rng.uniform(-5e3, 5e3, 3))
        for _ in range(length)
    ]
    return Trajectory(np.stack(poses), np.cumsum(rng.uniform(0, 1, length)) + 1.3e9)


@pytest.mark.parametrize("form", ["kitti", "tum"])
@settings(max_examples=30)
@given(trajectory=st.builds(random_trajectory, st.integers(0, 2**31), st.integers(1, 8)))
def test_poses_lose_nothing_that_matters(trajectory, form, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / f"poses_{form}.txt"
    (write_tum if form == "tum" else write_kitti_poses)(path, trajectory)
    read = read_trajectory(path, trajectory.timestamps_s if form == "kitti" else None)
    assert holds_times(path) == (form == "tum")
    # 12 digits of numbers up to 5 km: below a micrometre.
    np.testing.assert_allclose(read.T_world_camera, trajectory.T_world_camera, rtol=0, atol=1e-8)
    # A float64 near 1.3e9 seconds resolves 2.4e-7.
    np.testing.assert_allclose(read.timestamps_s, trajectory.timestamps_s, rtol=0, atol=1e-6)


def test_tum_line_is_time_position_and_quaternion_xyzw_with_positive_w(tmp_path):
    quarter_turn = make_transform(exp_so3(np.array([0, np.pi / 2, 0])), np.array([1.0, 2.0, 3.0]))
    path, half = tmp_path / "t.txt", np.sqrt(0.5)
    write_tum(path, Trajectory(quarter_turn[None], np.array([0.5])))
    numbers = [float(word) for word in path.read_text().split()]
    np.testing.assert_allclose(numbers, [0.5, 1, 2, 3, 0, half, 0, half], atol=1e-12)
    path.write_text("0 0 0 0 0.1 0.2 0.3 0.9273618\n1 0 0 0 -0.1 -0.2 -0.3 -0.9273618\n")
    first, second = read_tum(path).T_world_camera  # the negative is the same rotation
    np.testing.assert_allclose(first, second, rtol=0, atol=1e-12)


def test_rotations_of_few_digits_become_orthonormal_and_poses_get_times(tmp_path):
    path = tmp_path / "p.txt"
    path.write_text("0.9998 -0.02 0 1 0.02 0.9998 0 2 0 0 1 3\n")
    kitti = read_kitti_poses(path).T_world_camera[0]
    np.testing.assert_array_equal(kitti[:3, 3], [1, 2, 3])
    path.write_text("# groundtruth\n0 0 0 0 0.57 0.57 0.57 0.16\n")
    for pose in (kitti, read_tum(path).T_world_camera[0]):
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), rtol=0, atol=1e-14)
    (tmp_path / "p.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    assert read_kitti_poses(tmp_path / "p.txt").timestamps_s.tolist() == [0, 1]
    with pytest.raises(FormatError, match=r"p\.txt: numbers of poses .*\(got 2 poses, expected 3"):
        read_trajectory(tmp_path / "p.txt", np.arange(3.0))


@pytest.mark.real
@pytest.mark.parametrize(
    ("drive", "frames", "length_m"), [("kitti_raw_0013", 144, 173), ("kitti_06_51", 51, 60)]
)
def test_real_drives_have_their_published_length(recon_data, drive, frames, length_m):
    trajectory = read_trajectory(recon_data / "driven" / drive / "poses.txt")
    assert len(trajectory) == frames
    assert abs(trajectory.path_length_m - length_m) < 1
