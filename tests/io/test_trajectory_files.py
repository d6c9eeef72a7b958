"""Trajectories of others: columns that a header names, orders of quaternions, units of time."""

import numpy as np
import pytest

from recon.core.errors import EvaluationError, FormatError
from recon.core.geometry.se3 import exp_so3, make_transform, quaternion_from_rotation
from recon.core.values import Trajectory
from recon.evaluation.trajectory import associate, evaluate_trajectory
from recon.io.trajectory import holds_times, read_trajectory, read_tum, write_tum

pytestmark = pytest.mark.portable

START_S = 1_700_000_000.0


def drive(frames: int = 40, yaw_rad: float = 0.05, jitter_m: float = 0.02) -> Trajectory:
    """A vehicle that goes along its z axis through a bend, seen with an error."""
    step = make_transform(exp_so3(np.array([0.0, yaw_rad, 0.0])), np.array([0.0, 0.0, 1.0]))
    poses = np.stack([np.linalg.matrix_power(step, n) for n in range(frames)])
    poses[:, :3, 3] += np.random.default_rng(1).normal(0.0, jitter_m, (frames, 3))
    return Trajectory(poses, START_S + 0.1 * np.arange(frames))


def rows(path: Trajectory) -> np.ndarray:
    """Time, position and quaternion w x y z."""
    xyzw = np.array([quaternion_from_rotation(T[:3, :3]) for T in path.T_world_camera])
    return np.column_stack([path.timestamps_s, path.positions_m, np.roll(xyzw, 1, axis=1)])


def write(path, table, head="", mark=" ", unit=1.0, more=()):
    lines = [
        mark.join([f"{row[0] / unit:.9f}", *(f"{value:.9f}" for value in row[1:]), *more])
        for row in table
    ]
    path.write_text("\n".join([*filter(None, [head]), *lines]) + "\n")
    return path


EUROC = (
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], "
    "q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
)
VELOCITY = ", v_RS_R_x [m s^-1], b_w_RS_S_x [rad s^-1]"


@pytest.mark.parametrize(
    ("head", "mark", "unit", "more"),
    [
        (EUROC, ",", 1e-9, ()),
        (EUROC + VELOCITY, ", ", 1e-9, ("0.5", "nan")),
        (EUROC.replace(",", "").replace(" [ns]", ""), " ", 1e-9, ()),
        ("# timestamp tx ty tz qw qx qy qz", " ", 1.0, ()),
        ("# made by hand\n#time_ms tx ty tz qw qx qy qz", " ", 1e-3, ()),
        ("stamp [us];x;y;z;qw;qx;qy;qz;note", ";", 1e-6, ("slow, wet",)),
        ('"t"\t"pos_x"\t"pos_y"\t"pos_z"\t"quat_w"\t"quat_x"\t"quat_y"\t"quat_z"', "\t", 1.0, ()),
        ("%time," + ",".join(f"field.pose.position.{axis}" for axis in "xyz")
         + "," + ",".join(f"field.pose.orientation.{axis}" for axis in "wxyz")
         + ",field.twist.linear.x,field.header.frame_id", ",", 1e-9, ("7", "my map")),
    ],
)  # fmt: skip
def test_a_header_that_names_its_columns_is_believed(tmp_path, head, mark, unit, more):
    path = write(tmp_path / "poses.csv", rows(drive()), head, mark, unit, more)
    read = read_trajectory(path)
    np.testing.assert_allclose(read.T_world_camera, drive().T_world_camera, atol=1e-8)
    # Of 1.7e18 nanoseconds, float64 has steps of 256.
    np.testing.assert_allclose(read.timestamps_s, drive().timestamps_s, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(read_tum(path).T_world_camera, read.T_world_camera)
    assert holds_times(path)


def test_the_17_columns_of_euroc_need_no_header(tmp_path):
    zeros = ["0.0"] * 9
    path = write(tmp_path / "data.csv", rows(drive()), "", ",", 1e-9, zeros)
    read = read_trajectory(path)
    np.testing.assert_allclose(read.T_world_camera, drive().T_world_camera, atol=1e-8)
    np.testing.assert_allclose(read.timestamps_s, drive().timestamps_s, rtol=0, atol=1e-6)


@pytest.mark.parametrize("unit", [1e-3, 1e-6, 1e-9])
def test_times_since_1970_are_seconds_in_whatever_unit_they_are_counted(tmp_path, unit):
    table = rows(drive())[:, [0, 1, 2, 3, 5, 6, 7, 4]]
    read = read_trajectory(write(tmp_path / "poses.txt", table, unit=unit))
    np.testing.assert_allclose(read.timestamps_s, drive().timestamps_s, rtol=0, atol=1e-6)


def test_nanoseconds_of_a_clock_that_began_lately_are_no_milliseconds_since_1970(tmp_path):
    table = rows(drive())[:, [0, 1, 2, 3, 5, 6, 7, 4]]
    table[:, 0] -= START_S - 1700.0
    read = read_trajectory(write(tmp_path / "poses.txt", table, unit=1e-9))
    assert read.timestamps_s[0] == pytest.approx(1.7e12)
    with pytest.raises(EvaluationError, match=r"of the estimate are nanosec.*of the truth are sec"):
        associate(read, drive(), 0.01)
    with pytest.raises(EvaluationError, match=r"of the truth are nanosec.*of the estimate are sec"):
        associate(drive(), read, 0.01)


def test_an_order_in_which_motions_are_nonsense_is_refused_with_advice(tmp_path):
    path = write(tmp_path / "poses.txt", rows(drive()))
    said = r"poses\.txt: the quaternions are not in the order of TUM.*# timestamp tx .* qw qx qy qz"
    for read in (read_trajectory, read_tum):
        with pytest.raises(FormatError, match=said):
            read(path)


def carried(seed: int) -> Trajectory:
    """A rig in the hand: it goes anywhere and looks anywhere."""
    rng = np.random.default_rng(seed)
    turns = np.cumsum(rng.normal(0.0, 0.1, (60, 3)), axis=0)
    places = np.cumsum(rng.normal(0.0, 0.1, (60, 3)), axis=0)
    poses = [make_transform(exp_so3(turn), xyz) for turn, xyz in zip(turns, places, strict=True)]
    return Trajectory(np.stack(poses), 0.1 * np.arange(60))


def crabbing(turns_rad: float) -> Trajectory:
    """A platform that goes one way while it turns to and fro."""
    turns = turns_rad * np.sin(np.arange(60))
    poses = [make_transform(exp_so3(np.array([0.0, turn, 0.0])), np.array([0.0, 0.0, 0.1 * n]))
             for n, turn in enumerate(turns)]  # fmt: skip
    return Trajectory(np.stack(poses), 0.1 * np.arange(60))


SHAKEN_M = np.random.default_rng(5).normal(0.0, 0.01, (60, 3))
STANDING = Trajectory(
    np.stack([make_transform(np.eye(3), xyz) for xyz in SHAKEN_M]), 0.1 * np.arange(60)
)


@pytest.mark.parametrize(
    "path",
    [drive(), drive(yaw_rad=0.0), drive(yaw_rad=0.001), drive(jitter_m=0.5), crabbing(0.5),
     crabbing(1.5), STANDING, *(carried(seed) for seed in range(20))],
)  # fmt: skip
def test_the_order_of_tum_is_accepted_of_whatever_moves(tmp_path, path):
    write_tum(tmp_path / "poses.txt", path)
    read = read_trajectory(tmp_path / "poses.txt")
    np.testing.assert_allclose(read.T_world_camera, path.T_world_camera, atol=1e-8)


@pytest.mark.parametrize("spoiled", ["estimate", "truth"])
def test_beside_another_path_the_order_shows_on_a_straight_drive_too(tmp_path, spoiled):
    paths = {name: tmp_path / f"{name}.txt" for name in ("estimate", "truth")}
    for name, path in paths.items():
        straight = drive(yaw_rad=0.0, jitter_m=0.01)
        write(path, rows(straight)) if name == spoiled else write_tum(path, straight)
    said = (
        f"quaternions of the {spoiled} are not in the order of TUM.*got t_rel 20.%, and 0.*# time"
    )
    with pytest.raises(EvaluationError, match=said):
        evaluate_trajectory(paths["estimate"], paths["truth"])


def test_a_path_that_is_wrong_in_either_order_is_compared_as_it_is(tmp_path):
    truth, estimate = drive(), carried(3)
    estimate = Trajectory(estimate.T_world_camera[:40], truth.timestamps_s)
    assert evaluate_trajectory(estimate, truth).t_rel_percent > 50
