"""Cameras are opened together, and their frames paired by time."""

import numpy as np
import pytest

from recon.core.errors import SourceError
from recon.rig import capture
from recon.rig.capture import (
    CaptureFolder,
    CaptureSettings,
    RecordingSettings,
    capture_pairs,
    open_cameras,
    warm_up,
    write_pairs,
)


class FakeCamera:
    """A live camera whose frames come at given times."""

    def __init__(self, name: str, stamps_s: list[float], live: bool = True) -> None:
        self.name, self.live, self.rate_hz = name, live, 10.0
        self.stamps_s, self.at, self.exposure, self.closed = stamps_s, -1, 100.0, False

    def grab(self) -> float | None:
        self.at += 1
        return self.stamps_s[self.at] if self.at < len(self.stamps_s) else None

    def retrieve(self) -> np.ndarray:
        return np.full((8, 12, 3), round(100 * self.stamps_s[self.at]), np.uint8)

    def lock(self, exposure: float | None) -> float | None:
        self.exposure = self.exposure if exposure is None else exposure
        return self.exposure

    def close(self) -> None:
        self.closed = True


def test_a_camera_that_does_not_open_is_named_and_the_other_one_closed(monkeypatch):
    with (
        pytest.raises(SourceError, match="no-such-camera"),
        open_cameras(["/dev/no-such-camera"], CaptureSettings()),
    ):
        pass
    opened, asked = [], []

    def make(device: str, size: object, rate_hz: object) -> FakeCamera:
        if device == "bad":
            raise SourceError("camera cannot be opened", where=device)
        asked.append((size, rate_hz))
        opened.append(FakeCamera(device, []))
        return opened[-1]

    monkeypatch.setattr(capture, "Camera", make)
    settings = CaptureSettings(width_px=640, height_px=480, rate_hz=15)
    with pytest.raises(SourceError, match="bad"), open_cameras(["good", "bad"], settings):
        pass
    assert (asked, [camera.closed for camera in opened]) == ([((640, 480), 15.0)], [True])
    with open_cameras(["good"], CaptureSettings(width_px=640)) as cameras:
        assert not cameras[0].closed
    assert asked[-1] == (None, None)


def test_pairs_are_nearest_in_time_and_end_when_asked(tmp_path):
    times = [0.1 * k for k in range(10)]
    late = [t + 0.003 for t in times if t != times[3]]  # the right camera loses a frame

    def taken(**limits: float) -> list[tuple[float, float]]:
        cameras = FakeCamera("left", times, False), FakeCamera("right", late, False)
        settings = RecordingSettings.parse(limits)
        return [(p.left_s, p.right_s) for p in capture_pairs(cameras, settings, lambda: False)]

    assert [left for left, _ in taken()] == [t for t in times if t != times[3]]
    assert max(right - left for left, right in taken()) < 0.004
    assert (len(taken(frames=4)), len(taken(seconds=0.55))) == (4, 5)
    cameras = FakeCamera("left", times), FakeCamera("right", times)
    assert warm_up(cameras, CaptureSettings(lock_exposure=False)) is False
    assert cameras[0].at == 14
    with pytest.raises(SourceError, match=r"left: .*no more frames"):
        list(capture_pairs(cameras, RecordingSettings(), lambda: False))
    cameras = FakeCamera("left", times, False), FakeCamera("right", late, False)
    with CaptureFolder(tmp_path / "out", "png") as folder:
        write_pairs(capture_pairs(cameras, RecordingSettings(), lambda: False), folder, 4)
    assert (tmp_path / "out" / "preview.jpg").is_file()
    figures = folder.figures
    assert (figures["frames"], figures["gaps"]) == (9, 1)
    assert (figures["rate_hz"], figures["seconds"]) == pytest.approx((10.0, 0.9))
    assert figures["skew_mean_ms"] == pytest.approx(figures["skew_max_ms"]) == pytest.approx(3.0)
