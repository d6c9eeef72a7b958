"""Images that arrive in their own time: live cameras, and recordings that are played."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from threading import Condition, Thread
from typing import Final

import cv2
import numpy as np

from recon.core.errors import SourceError
from recon.core.text import counted, is_count
from recon.core.values import ImuRecord, Recorded, Rig, Trajectory
from recon.core.values.arrays import Float64, UInt8
from recon.io.images.image import silent_opencv
from recon.sources.source import (
    DerivedSource,
    Latency,
    LiveFigures,
    SourceFigures,
    StereoSource,
)

# Pairs that may wait; where another comes, the oldest is dropped. With one, a slow consumer always
# gets the newest pair, and what is dropped is spread evenly.
_WAITING: Final = 1
_PATIENCE_S: Final = 0.2  # how long to wait for a pair before asking whether to stop


class LiveSource(DerivedSource):
    """The pairs of a source when they are due, read by a thread; of those that wait, the newest.

    ``rate`` is how many times as fast as recorded it is played; None = pairs are due when they were
    taken, by `time.monotonic`. Where ``stopped()`` is True the drive ends.
    """

    live = True
    slower = "play it more slowly, such as --rate 0.5"
    """What to do where pairs arrive too fast."""

    def __init__(
        self,
        source: StereoSource,
        rate: float | None = 1.0,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(source)
        if rate is not None:
            self.description += f", played at {rate:g} times its speed"
        self.rate = rate
        self._stopped = stopped
        self._waiting: deque[tuple[Recorded, float]] = deque()
        self._news = Condition()
        self._ended = False
        self._error: BaseException | None = None
        self._due_s: list[float] = []
        self._latency_s: list[float] = []
        self._unmatched = 0
        self.dropped = 0

    def __len__(self) -> int:
        return len(self.source)

    def frames(self, start: int = 0) -> Iterator[Recorded]:
        Thread(target=self._play, args=(start,), name="live", daemon=True).start()
        try:
            while (pair := self._take()) is not None:
                yield pair
        finally:
            self._ended = True

    def read_imu(self) -> ImuRecord | None:
        return self.source.read_imu() if self.source.live else None

    def asked_start(self) -> Float64 | None:
        return self.source.asked_start()

    def recent_path(self) -> Trajectory | None:
        return self.source.recent_path()

    def hurried(self) -> bool:
        return bool(self._waiting)

    def note_unmatched(self) -> None:
        self._unmatched += 1

    def note_located(self, index: int) -> None:
        """Measure the time from the arrival of a pair to its pose."""
        self._latency_s.append(time.monotonic() - self._due_s[index])

    def figures(self) -> SourceFigures:
        latency_ms = Latency(None, None, None)
        if self._latency_s:
            found = np.percentile(1e3 * np.array(self._latency_s), [50, 95, 100]).tolist()
            latency_ms = Latency(*(round(value, 1) for value in found))
        live = LiveFigures(
            rate=self.rate,
            frames_arrived=len(self._due_s) + self.dropped,
            frames_dropped=self.dropped,
            frames_not_matched=self._unmatched,
            latency_ms=latency_ms,
        )
        known = self.source.figures() if self.source.live else SourceFigures()
        return replace(known, live=live)

    def warnings(self) -> list[str]:
        lines = self.source.warnings() if self.source.live else []
        if self._unmatched:
            what = "tracked but not matched, so their points are not in the map"
            lines.append(f"{counted(self._unmatched, 'frame')} arrived too fast, {what}")
        if self.dropped:
            lines.append(f"{counted(self.dropped, 'frame')} arrived too fast, dropped")
        return lines

    def _play(self, start: int) -> None:
        begun_s, first_s = time.monotonic(), None
        try:
            for pair in self.source.frames(start):
                first_s = pair.timestamp_s if first_s is None else first_s
                due_s = self.source.due_s(pair)
                if self.rate is not None:
                    due_s = begun_s + (pair.timestamp_s - first_s) / self.rate
                time.sleep(max(0.0, due_s - time.monotonic()))
                if self._ended:
                    return
                self._put(pair, due_s)
        except BaseException as error:  # noqa: BLE001 - raised where the pairs are taken
            self._error = error
        finally:
            with self._news:
                self._ended = True
                self._news.notify()

    def _put(self, pair: Recorded, due_s: float) -> None:
        with self._news:
            if len(self._waiting) == _WAITING:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append((pair, due_s))
            self._news.notify()

    def _take(self) -> Recorded | None:
        with self._news:
            while not (self._waiting or self._ended or self._stopped()):
                self._news.wait(_PATIENCE_S)
            if self._stopped():
                if not self._due_s:
                    raise SourceError("the drive was stopped before its first frame")
                return None
            if not self._waiting:
                if self._error is not None:
                    raise self._error
                return None
            pair, due_s = self._waiting.popleft()
            self._news.notify()
        self._due_s.append(due_s)
        return pair


class _Rig(StereoSource):
    """Cameras of which a program has the images."""

    name, description = "pushed pairs", "pairs that a program has"
    calibration: Rig

    def __init__(self, calibration: Rig) -> None:
        self.calibration = calibration

    def __len__(self) -> int:
        return 0

    def frames(self, start: int = 0) -> Iterator[Recorded]:
        return iter(())


class PushedSource(LiveSource):
    """Pairs that a program pushes when it has them, until `end`.

    Where it is ``patient`` a push waits until the pair before is mapped, and none is left out. The
    first pairs that are read are then given again, since they are looked at before the drive.
    """

    slower = "push fewer pairs each second, or wait for each: LiveMap(…, wait=True)"

    def __init__(self, calibration: Rig, *, patient: bool = False) -> None:
        super().__init__(_Rig(calibration), rate=None)
        self.patient = patient
        self._again: list[Recorded] | None = None

    def frames(self, start: int = 0) -> Iterator[Recorded]:
        looking, again = self._again is None, self._again or []
        self._again = []
        self._due_s, self.dropped = [time.monotonic()] * len(again), 0
        yield from again
        while (pair := self._take()) is not None:
            if looking and self.patient:
                self._again.append(pair)
            yield pair

    def push(self, pair: Recorded) -> None:
        with self._news:
            while self.patient and self._waiting and not self._ended:
                self._news.wait()
        self._put(pair, time.monotonic())

    def end(self, error: BaseException | None = None) -> None:
        """End the drive, perhaps by an error that is raised where pairs are taken."""
        with self._news:
            self._error = error
            if error is not None:
                self._waiting.clear()
            self._ended = True
            self._news.notify_all()


_LONGEST_NUMBER: Final = 10
_HEAD_BYTES: Final = 4096
# V4L2's exposure modes: 1 = manual, 3 = automatic.
_MANUAL: Final = 1


class Camera:
    """A device (``0``, ``/dev/video0``), asked for size and rate, or a video file, not ``live``."""

    def __init__(
        self, device: str, size: tuple[int, int] | None = None, rate_hz: float | None = None
    ) -> None:
        self.name, self.live = device, not Path(device).is_file()
        number = int(device) if is_count(device) and len(device) < _LONGEST_NUMBER else None
        if Path(device).is_fifo() or Path(device).is_socket():  # opening one would wait for ever
            raise SourceError("not a camera and not a regular file", where=device)
        if not self.live and _is_text(Path(device)):  # which OpenCV draws, letter by letter
            raise SourceError("not a video", where=device, got="a text file")
        with silent_opencv():
            self._capture = cv2.VideoCapture(device if number is None else number)
        if not self._capture.isOpened():
            found = ", ".join(sorted(str(path) for path in Path("/dev").glob("video*")))
            expected = f"one of {found}" if found else "a camera: there is no /dev/video*"
            hint = "another program may be using it"
            raise SourceError("camera cannot be opened", where=device, expected=expected, hint=hint)
        if self.live:
            self._ask(size, rate_hz)

    @property
    def rate_hz(self) -> float:
        """Frames per second; NaN if the driver does not report it."""
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        return float(rate) if rate > 0 else float("nan")

    def grab(self) -> float | None:
        """Grab the next frame without decoding it; returns its time in seconds, None = the end."""
        if not self._capture.grab():
            return None
        now_s = time.monotonic()
        stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        # A driver without timestamps returns 0, or uses another clock.
        believed = not self.live or 0 <= now_s - stamp_s < 1
        return float(stamp_s) if believed else now_s

    def retrieve(self) -> UInt8:
        """Decode the grabbed frame: uint8 (H, W, 3) RGB."""
        done, image = self._capture.retrieve()
        if not done:
            raise SourceError("frame cannot be decoded", where=self.name)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def lock(self, exposure: float | None) -> float | None:
        """Fix white balance and exposure (None = the current); returns it, None = not supported."""
        if not self.live:
            return None
        value = self._capture.get(cv2.CAP_PROP_EXPOSURE) if exposure is None else exposure
        self._capture.set(cv2.CAP_PROP_AUTO_WB, 0)
        held = self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL) and self._capture.set(
            cv2.CAP_PROP_EXPOSURE, value
        )
        return float(value) if held else None

    def close(self) -> None:
        self._capture.release()

    def _ask(self, size: tuple[int, int] | None, rate_hz: float | None) -> None:
        if rate_hz is not None:
            self._capture.set(cv2.CAP_PROP_FPS, rate_hz)
        if size is None:
            return
        keys = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        for key, value in zip(keys, size, strict=True):
            self._capture.set(key, value)
        given = tuple(int(self._capture.get(key)) for key in keys)
        if given != size:
            what, got = "camera does not support this image size", f"{given[0]}x{given[1]}"
            raise SourceError(what, where=self.name, got=got, expected=f"{size[0]}x{size[1]}")


def _is_text(path: Path) -> bool:
    """Return whether a file begins with printable text, as no video does."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES).decode("latin-1")
    return bool(head) and all(letter.isprintable() or letter.isspace() for letter in head)
