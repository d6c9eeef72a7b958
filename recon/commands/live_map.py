"""A map while a program that has the images pushes them: `recon.LiveMap`."""

from __future__ import annotations

import contextvars
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock, Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from recon.commands.config import ReconConfig, load_config
from recon.commands.localize import run_live
from recon.commands.map_options import MapOptions
from recon.commands.map_summary import MapSummary
from recon.core.errors import MappingError, ShapeError, SourceError
from recon.core.values import (
    OccupancyGrid,
    PointCloud,
    RectifiedCamera,
    Rig,
    StereoCalibration,
    StereoPair,
    join_clouds,
)
from recon.core.values.camera import check_size
from recon.export.growing import GrowingMap, MapBeside, MapSoFar
from recon.io.cameras.calibration import read_calibration
from recon.io.files import StrPath
from recon.map.listener import DriveBegun, DriveListener, DrivePose
from recon.map.localize.sequence import LocalizeSummary, StartPose
from recon.map.store.map_file import MAP_FILE
from recon.sources.calibration import as_rectified
from recon.sources.live import PushedSource


class LiveMap:
    """A map that is made, or searched, while a program pushes pairs of images.

    ::

        with recon.LiveMap(calibration) as live:
            for left, right, time_s in pairs:
                live.push(left, right, time_s)
                print(live.pose)
            grid = live.grid()

    The work is that of `recon.run_live`, in another thread, which begins with the first pair.
    Leaving the ``with`` statement completes the map. An error of that thread is raised by
    whatever is called next.

    Args:
        calibration: Of the cameras, or its file. Of images that are rectified, a `RectifiedCamera`.
        config: The configuration; None = the defaults.
        map_path: Find the pairs in this map instead of making one, as `recon.run_localize` does.
        start: Where the drive begins in it, roughly; None = anywhere.
        out: Folder of the run with all that `recon.run_live` leaves; None = nothing is kept once
            this object is gone.
        wait: Whether `push` waits until the pair before is mapped, so that none is left out: for
            recordings. Else it returns at once, and where pairs come too fast the newest count.

    Raises:
        ReconError: The calibration is none, or no pair was pushed; or as for `recon.run_live`.
    """

    def __init__(
        self,
        calibration: Rig | StrPath,
        config: ReconConfig | None = None,
        *,
        map_path: StrPath | None = None,
        start: StartPose | None = None,
        out: StrPath | None = None,
        wait: bool = False,
    ) -> None:
        self._calibration, self._config, self._wait = calibration, config or load_config(), wait
        self._map_path, self._start = map_path, start
        self._gone = TemporaryDirectory(prefix="recon-") if out is None else None
        self._out = Path(self._gone.name if self._gone else str(out))
        self._source: PushedSource | None = None
        self._thread: Thread | None = None
        self._error: BaseException | None = None
        self._last_s, self._over = -math.inf, False
        self._newest = _Newest()
        self._asking, self._pushing = Lock(), Lock()
        self._maps: MapBeside | GrowingMap | None = None
        self._made: MapSoFar | None = None
        self.summary: MapSummary | LocalizeSummary | None = None
        """What `recon.run_live` found, once the drive is over."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        self._over = True
        if self._source is not None and self._thread is not None:
            given_up = kind is not None and self._gone is not None
            self._source.end(SourceError("the drive was given up") if given_up else None)
            self._thread.join()
        if isinstance(self._maps, MapBeside):
            self._maps.close()
            self._maps = None
        if kind is None:
            self._check()
            if self._source is None:
                raise SourceError("no pair was pushed, so there is no map")

    def push(self, left: NDArray[np.uint8], right: NDArray[np.uint8], time_s: float) -> None:
        """Push the next pair.

        Args:
            left: uint8 (H, W) grey or (H, W, 3) RGB; it is copied.
            right: Of the same size.
            time_s: When they were taken, seconds on any clock; later than the pair before.

        Raises:
            ReconError: The images are of another kind, or of another size than the calibration;
                the time is not finite or not later; the drive is over; or the work has failed.
        """
        self._check()
        if self._over:
            raise SourceError("the drive is over: nothing can be pushed any more")
        with self._pushing:  # the first pair begins the work, once
            self._push(left, right, time_s)
        self._check()

    @property
    def pose(self) -> DrivePose | None:
        """The newest pose, perhaps of a pair before the last; None = none is known yet."""
        self._check()
        return self._newest.pose

    @property
    def dropped(self) -> int:
        """How many pairs were left out, since they came too fast."""
        return 0 if self._source is None else self._source.dropped

    def grid(self) -> OccupancyGrid:
        """Return the flat grid of the map so far, which a process makes where it has grown.

        Raises:
            MappingError: There is nothing in the map yet.
        """
        return self._so_far().grid

    def costmap(self) -> OccupancyGrid:
        """Return the costs of the map so far for the robot of the settings; as `grid`."""
        made = self._so_far()
        if made.costs is None:
            raise MappingError(made.note or "there is no costmap")
        return made.costs

    def cloud(self) -> PointCloud:
        """Return the points of the map so far, frame ``map``; as `grid`."""
        return self._so_far().cloud

    def _push(self, left: NDArray[np.uint8], right: NDArray[np.uint8], time_s: float) -> None:
        number, name = self._newest.pushed, f"pair {self._newest.pushed}"
        now_s = float(time_s) if isinstance(time_s, int | float | np.number) else math.nan
        if not self._last_s < now_s < math.inf:
            what, expected = "not the time of a later pair", f"seconds after {self._last_s:g}"
            raise SourceError(what, where=name, got=time_s, expected=expected)
        images: tuple[Any, ...] = (left, right)
        if not all(isinstance(one, np.ndarray) for one in images):
            got = " and ".join(type(one).__name__ for one in images)
            raise ShapeError("not two images", where=name, got=got, expected="uint8 arrays")
        pair = StereoPair(left.copy(), right.copy(), now_s, number, name)
        height_px, width_px = pair.left.shape[:2]
        source = self._begin(width_px, height_px) if self._source is None else self._source
        check_size(source.calibration, width_px, height_px, pair.name)
        self._last_s, self._newest.pushed = now_s, self._newest.pushed + 1
        source.push(pair)

    def _begin(self, width_px: int, height_px: int) -> PushedSource:
        rig = self._calibration
        if not isinstance(rig, RectifiedCamera | StereoCalibration):
            rig = as_rectified(read_calibration(rig, width_px, height_px))
        source = PushedSource(rig, patient=self._wait)
        check_size(rig, width_px, height_px, "the first pair")
        # What shows progress around the program shows that of the thread.
        work = partial(contextvars.copy_context().run, self._work, source)
        self._thread = Thread(target=work, name="live-map", daemon=True)
        self._thread.start()
        self._source = source
        return source

    def _work(self, source: PushedSource) -> None:
        try:
            options = MapOptions("live", self._out, mesh=False, listener=self._newest)
            found = partial(run_live, source, self._config, options)
            self.summary = found(map_path=self._map_path, start=self._start)
        except BaseException as error:  # noqa: BLE001 - raised where the program can see it
            self._error = error
        finally:
            source.end(self._error)

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _so_far(self) -> MapSoFar:
        self._check()
        with self._asking:
            begun = self._newest.begun
            if self._maps is None and self.summary is not None and self._map_path is None:
                # No pose is waited for any more, and the corrected map is in another file.
                self._maps, self._made = GrowingMap(self._out / MAP_FILE, finished=True), None
            elif self._maps is None and begun is not None and begun.map_path is not None:
                self._maps = MapBeside(begun.map_path, finished=begun.in_map)
            new = None if self._maps is None else self._maps.update()
            if new is not None and self._made is not None:
                new = replace(new, cloud=join_clouds([self._made.cloud, new.cloud]))
            self._made = new or self._made
            if self._made is None:
                raise MappingError("there is nothing in the map yet")
            return self._made


class _Newest(DriveListener):
    """Keeps what is newest of a drive."""

    begun: DriveBegun | None = None
    pose: DrivePose | None = None
    pushed = 0

    def on_begin(self, begun: DriveBegun) -> None:
        self.begun = begun

    def on_pose(self, pose: DrivePose) -> None:
        self.pose = pose
