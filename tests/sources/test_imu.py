"""Inertial units of EuRoC's folders and of bags, whole and damaged."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from recon.core.errors import ReconError
from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import ImuRecord
from recon.sources.registry import open_source
from tests.sources import drives
from tests.sources.bags import TOPICS, Recording, recorder
from tests.sources.drives import CAMERA, stamp_ns

T_BODY_CAMERA = make_transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
T_BODY_IMU = make_transform(exp_so3(np.array([0.1, 0.2, 0.3])), np.array([0.1, 0.0, 0.2]))
ROWS = [f"{drives.EPOCH_S * 10**9 + 5_000_000 * k},0.1,{k},0.3,1,2,9.8" for k in range(200)]


def write(folder: Path, rows: list[str], T: np.ndarray | None = T_BODY_IMU) -> Path:
    unit = folder / "mav0" / "imu0"
    unit.mkdir()
    (unit / "data.csv").write_text("#timestamp [ns],w,a\n" + "\n".join(rows) + "\n")
    content = {} if T is None else {"T_BS": {"rows": 4, "cols": 4, "data": T.ravel().tolist()}}
    (unit / "sensor.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump({"rate_hz": 200, **content}))
    return unit


def read(folder: Path) -> ImuRecord:
    found = open_source(folder).read_imu()
    assert found is not None
    return found


def test_a_unit_of_euroc_is_read_with_its_axes(noise, tmp_path):
    drives.write_euroc(noise, CAMERA, tmp_path)
    assert open_source(tmp_path).read_imu() is None
    unit = write(tmp_path, ROWS)
    record = read(tmp_path)
    assert (len(record), record.notes) == (200, ())
    # Stamps of today have 0.2 µs in a double.
    np.testing.assert_allclose(np.diff(record.timestamps_s), 0.005, atol=5e-7)
    np.testing.assert_array_equal(record.gyro[7], [0.1, 7, 0.3])
    np.testing.assert_array_equal(record.accel[7], [1, 2, 9.8])
    expected = invert(T_BODY_CAMERA) @ T_BODY_IMU
    np.testing.assert_allclose(record.T_camera_imu, expected, atol=1e-12)
    assert unit / "data.csv" in open_source(tmp_path).files


BROKEN = {
    "cut": ([*ROWS[:50], ROWS[50][:25]], 50, r"1 row of 51 .* \(first data.csv:52\)"),
    "not finite": ([*ROWS[:9], ROWS[9].replace("0.3", "nan"), *ROWS[10:]], 199, r"data.csv:11"),
    "backwards": ([*ROWS[:60], *ROWS[40:]], 200, r"20 rows of 220"),
    "a stamp far ahead": ([*ROWS[:9], "9" + ROWS[9][1:], *ROWS[10:]], 199, r"data.csv:11"),
    "a rate of no gyro": ([*ROWS[:9], ROWS[9].replace("0.3", "1e300"), *ROWS[10:]], 199, r"csv:11"),
    "in no order": ([*ROWS[1::3], *ROWS[::3], *ROWS[2::3]][::-1], 200, r"not in order of time"),
    "each row three times": ([row for row in ROWS for _ in range(3)], 200, r"400 rows of 600"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_rows_that_are_no_measurement_are_left_out_and_said(noise, tmp_path, name):
    rows, left, said = BROKEN[name]
    write(drives.write_euroc(noise, CAMERA, tmp_path), rows)
    record = read(tmp_path)
    assert len(record) == left
    assert (np.diff(record.timestamps_s) > 0).all()
    (note,) = record.notes
    assert re.search(said, note)


def test_a_file_without_measurements_and_axes_that_are_none_are_one_line(noise, tmp_path):
    unit = write(drives.write_euroc(noise, CAMERA, tmp_path), ["a,b"])
    with pytest.raises(ReconError, match=r"data\.csv: IMU has no measurements .*1 row, of which 0"):
        open_source(tmp_path).read_imu()
    (unit / "data.csv").write_text("\n".join(ROWS))
    for text, said, axes in (
        ("rate_hz: 200", r"has no 'T_BS'.*those that the drive shows", False),
        ("T_BS: {data: [" + "2, " * 15 + "2]}", r"not a rigid transform.*the drive shows", False),
        (None, r"sensor\.yaml is missing: taken as the body", True),
    ):
        if text is None:
            (unit / "sensor.yaml").unlink()
        else:
            (unit / "sensor.yaml").write_text(text)
        record = read(tmp_path)
        (note,) = record.notes
        assert re.search(said, note)
        assert (record.T_camera_imu is not None) is axes


def test_kalibrs_chain_says_where_the_unit_of_tum_vi_is(noise, tmp_path):
    unit = write(drives.write_euroc(noise, CAMERA, tmp_path), ROWS)
    for path in tmp_path.rglob("sensor.yaml"):
        path.unlink()
    camera = {
        "camera_model": "pinhole", "distortion_model": "none", "distortion_coeffs": [],
        "intrinsics": [60.0, 60.0, 31.5, 15.5], "resolution": [64, 32],
    }  # fmt: skip
    T = make_transform(np.eye(3), np.array([-CAMERA.baseline_m, 0, 0]))
    chain = {"cam0": {**camera, "T_cam_imu": T_BODY_IMU.tolist()},
             "cam1": {**camera, "T_cn_cnm1": T.tolist()}}  # fmt: skip
    (tmp_path / "dso").mkdir()
    (tmp_path / "dso" / "camchain.yaml").write_text(yaml.safe_dump(chain))
    record = read(tmp_path)
    np.testing.assert_allclose(record.T_camera_imu, T_BODY_IMU, atol=1e-12)
    del chain["cam0"]["T_cam_imu"]
    (tmp_path / "dso" / "camchain.yaml").write_text(yaml.safe_dump(chain))
    assert f"{unit / 'sensor.yaml'} states no axes" in read(tmp_path).notes[0]


@pytest.mark.parametrize("kind", ["ros1", "ros2", "mcap"])
def test_a_unit_of_a_bag_is_read_and_placed_by_static_transforms(noise, tmp_path, kind):
    how = Recording(kind)
    with recorder(tmp_path, how) as bag:
        start = stamp_ns(noise[0])
        bag.write("/tf_static", start, bag.transforms(
            bag.transform(start, "cam", "imu_link", T_BODY_IMU)))  # fmt: skip
        for pair in noise:
            stamp = stamp_ns(pair)
            bag.camera_infos(stamp, CAMERA)
            for topic, image in zip(TOPICS, (pair.left, pair.right), strict=True):
                bag.write(topic, stamp, bag.image(stamp, image))
            for k in range(20):
                message = bag.imu(stamp, np.array([0.1, k, 0.3]), np.array([0, 0, 9.8]), "imu_link")
                message.header.stamp.nanosec += 5_000_000 * k
                bag.write("/imu/data", stamp + 5_000_000 * k, message)
    source = open_source(how.path(tmp_path))
    assert "other topics: /tf_static" in source.description
    record = source.read_imu()
    assert (len(record), record.notes) == (240, ())
    np.testing.assert_allclose(record.T_camera_imu, T_BODY_IMU, atol=1e-12)
    np.testing.assert_array_equal(record.gyro[5], [0.1, 5, 0.3])
