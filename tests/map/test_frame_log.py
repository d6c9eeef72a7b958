"""What a drive knows of its frames goes to a file that only grows, and comes back bit by bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.map.frame_log import FrameLog
from recon.odometry import OdometryHealth


def _fill(log: FrameLog, first: int, last: int) -> None:
    for number in range(first, last):
        rng = np.random.default_rng(number)
        health = OdometryHealth(
            ok=number % 3 > 0,
            tracks=number,
            reprojection_px=float(rng.normal()) if number % 2 else float("nan"),
            notes=("a", "ü") if number % 5 == 0 else (),
        )
        log.add(rng.normal(size=(4, 4)) * 10.0 ** rng.integers(-9, 9), number / 7, health)


def _assert_same(one: FrameLog, other: FrameLog) -> None:
    np.testing.assert_array_equal(one.trajectory.T_world_camera, other.trajectory.T_world_camera)
    np.testing.assert_array_equal(one.trajectory.timestamps_s, other.trajectory.timestamps_s)
    assert list(map(repr, one.health)) == list(map(repr, other.health))


def _restored(path: Path, state: list[int] | None) -> FrameLog:
    log = FrameLog(path)
    log.restore(state)
    return log


def test_frames_come_back_bit_by_bit(tmp_path: Path) -> None:
    log = FrameLog(tmp_path / "frames")
    for last in (1, 8, 8, 40):
        _fill(log, len(log), last)
        _assert_same(_restored(tmp_path / "frames", log.state()), log)


def test_a_state_writes_the_frames_since_the_last_one_alone(tmp_path: Path) -> None:
    path = tmp_path / "frames"
    log = FrameLog(path)
    _fill(log, 0, 30)
    log.state()
    before = path.read_bytes()
    path.write_bytes(bytes(len(before)))
    _fill(log, 30, 32)
    log.state()
    after = path.read_bytes()
    assert after.startswith(bytes(len(before)))
    assert after.count(b"\n") == 2


def test_what_was_written_after_the_last_checkpoint_is_forgotten(tmp_path: Path) -> None:
    path = tmp_path / "frames"
    log, unbroken = FrameLog(path), FrameLog(tmp_path / "unbroken")
    _fill(log, 0, 5)
    kept = list(log.state() or [])
    _fill(log, 5, 12)
    log.state()  # the process is killed before the checkpoint that counts these frames
    again = _restored(path, kept)
    assert len(again) == 5
    for number in (6, 20):
        _fill(again, len(again), number)
        state = again.state()
    _fill(unbroken, 0, 20)
    assert unbroken.state() == state
    assert path.read_bytes() == (tmp_path / "unbroken").read_bytes()


def test_without_a_file_all_stays_in_memory() -> None:
    log = FrameLog(None)
    _fill(log, 0, 3)
    assert log.state() is None
    assert len(log) == len(log.health) == 3
