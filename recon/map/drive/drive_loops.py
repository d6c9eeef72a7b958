"""The loops of a drive: detected frame by frame, closed at its end."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.summary import Figures
from recon.core.text import counted
from recon.core.values import RectifiedCamera, Trajectory
from recon.core.values.arrays import Float64
from recon.core.work import Stopwatch
from recon.map.store.session import Keyframes
from recon.odometry.protocol import OdometryHealth
from recon.places.adjustment import Adjustment, AdjustmentFigures, adjust_path
from recon.places.closure import Closure, DrivePath, close_loops
from recon.places.detector import CONTRADICTED, LoopDetector
from recon.places.places import path_lengths
from recon.stereo.frame import ReconstructedFrame

_TELLING: Final = 3  # implausible place recognitions from which a warning is given
_BEHIND: Final = 4  # frames by which loop detection may lag behind


@dataclass(frozen=True, kw_only=True)
class LoopFigures(Figures):
    """How many loops of a drive were found and closed, and what that moved."""

    keyframes: int
    found: int  # that passed the geometric check
    unconfirmed: int  # of these, without a neighbour that agrees
    closed: int
    refused_by_graph: int
    refused: Mapping[str, int]  # candidates, by reason
    largest_correction_m: float
    adjusted: AdjustmentFigures | None


@dataclass(frozen=True, eq=False)
class DriveLoops:
    """The result of loop closure on a drive: the path before and after it, and the loops.

    ``found`` is how many passed the geometric check, confirmed by neighbours or not; ``refused``
    how many candidates were rejected, by reason.
    """

    odometry: Trajectory
    closure: Closure
    keyframes: int
    found: int
    refused: dict[str, int]
    adjustment: Adjustment | None = None  # of the path after closure; None = there is none

    @property
    def corrections_m(self) -> Float64:
        """float64 (N,), how far each pose was moved."""
        moved = self.closure.trajectory.positions_m - self.odometry.positions_m
        return np.asarray(np.linalg.norm(moved, axis=1))

    def figures(self) -> LoopFigures:
        closed, refused = len(self.closure.closed), len(self.closure.refused)
        return LoopFigures(
            keyframes=self.keyframes,
            found=self.found,
            unconfirmed=self.found - closed - refused,
            closed=closed,
            refused_by_graph=refused,
            refused=dict(sorted(self.refused.items())),
            largest_correction_m=float(self.corrections_m.max(initial=0.0)),
            adjusted=None if self.adjustment is None else self.adjustment.figures,
        )

    def record(self) -> dict[str, Any]:
        """Return what a map keeps of it: the loops, and the path after closure if any closed."""
        closed, refused = self.closure.closed, self.closure.refused
        return {
            "closed": [asdict(loop) for loop in closed],
            "refused": [asdict(loop) for loop in refused],
            "T_world_camera": self.closure.trajectory.T_world_camera if closed else None,
        }

    def warnings(self) -> list[str]:
        """Return warnings about loops that were not closed."""
        closed, refused = len(self.closure.closed), len(self.closure.refused)
        if refused and not closed:
            what = "they contradict odometry, or too few agree; the map may show a place twice"
            return [f"{counted(refused, 'loop')} found and none closed: {what}"]
        if refused:
            loops = counted(refused + closed, "loop")
            return [f"{refused} of {loops} contradict the others; they are left"]
        elsewhere = self.refused.get(CONTRADICTED, 0)
        if elsewhere >= _TELLING and not closed:
            where = f"{counted(elsewhere, 'place')} recognised outside the bounds of odometry drift"
            return [f"{where}: perceptual aliasing, or odometry is far off"]
        return []


class LoopWatch:
    """Keeps keyframes in its own thread while a drive is mapped, and closes loops at its end.

    Keyframes that are kept already are of the frames before. Without ``search`` they are kept, too,
    to find later drives in the map.
    """

    def __init__(
        self,
        keyframes: Keyframes,
        camera: RectifiedCamera,
        stopwatch: Stopwatch | None = None,
        *,
        search: bool = True,
        scale: float = 1.0,
    ) -> None:
        self.searching, self._scale = search, scale
        self._stage = (stopwatch or Stopwatch()).stage
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="loops")
        self._waiting: deque[Future[None]] = deque()
        self._keyframes, self._camera = keyframes, camera
        self._detector = LoopDetector(keyframes, camera, search=search, scale=scale)
        self._path_m: list[float] = []
        self._last: Float64 = np.eye(4)

    def add(self, frame: ReconstructedFrame, T_world_camera: Float64, segment: int) -> None:
        """Add the next frame; earlier ones may still be in progress."""
        path_m, number = self._advance(T_world_camera, segment), len(self._path_m) - 1

        def look() -> None:
            with self._stage("loops"):
                self._detector.add(
                    number,
                    frame.pair,
                    frame.disparity,
                    T_world_camera,
                    path_m=path_m,
                    segment=segment,
                )

        self._wait(_BEHIND)
        self._waiting.append(self._pool.submit(look))

    def wait(self) -> None:
        self._wait(0)

    def stop(self) -> None:
        """End the thread; pending frames are dropped."""
        self._pool.shutdown(cancel_futures=True)

    def restore(self, T_world_camera: Iterable[Float64], segments: NDArray[np.int64]) -> None:
        """Resume after frames with these poses, whose keyframes are kept."""
        for T, segment in zip(T_world_camera, segments.tolist(), strict=True):
            self._advance(T, segment)
        for stored in self._keyframes:
            self._detector.restore(stored)

    def close(self, trajectory: Trajectory, health: Sequence[OdometryHealth]) -> DriveLoops:
        """Close the loops of a path by odometry, and adjust it to what its keyframes see."""
        self.wait()
        path = DrivePath.of(trajectory, health, self._scale)
        closure = close_loops(path, self._detector.agreeing())
        adjusted = adjust_path(path, closure, self._keyframes, self._camera)
        if adjusted is not None:
            closure = replace(closure, trajectory=adjusted.trajectory)
        return DriveLoops(
            odometry=trajectory,
            closure=closure,
            keyframes=len(self._detector),
            found=len(self._detector.loops),
            refused=dict(self._detector.refused),
            adjustment=adjusted,
        )

    def _wait(self, left: int) -> None:
        while len(self._waiting) > left:
            self._waiting.popleft().result()

    def _advance(self, T_world_camera: Float64, segment: int) -> float:
        """Return path length up to the next frame, as the detector measures it."""
        before = self._last if self._path_m else T_world_camera
        poses, trusted = np.stack([before, T_world_camera]), np.array([True, segment >= 0])
        step = path_lengths(poses, trusted, self._scale)
        self._path_m.append((self._path_m[-1] if self._path_m else 0.0) + float(step[1]))
        self._last = T_world_camera
        return self._path_m[-1]
