"""One frame, from the recorded pair to a filtered cloud: the stateless part of the pipeline."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from recon.core.values import (
    Disparity,
    PointCloud,
    RayCloud,
    RectifiedCamera,
    RectifiedPair,
    Rig,
    StereoPair,
)
from recon.run.stopwatch import Stopwatch
from recon.stereo.cloud.back_project import back_project
from recon.stereo.cloud.edges import remove_flying_edges
from recon.stereo.cloud.filters import filter_cloud
from recon.stereo.match.half_size import HalfSizeMatcher
from recon.stereo.match.registry import make_matcher
from recon.stereo.rectify.inspect import check_inspection, inspect_pair
from recon.stereo.rectify.rectifier import Rectifier
from recon.stereo.settings import StereoSettings

_INSPECT_EVERY: Final = 50
"""Frames from one inspection to the next: what it looks for, swapped cameras or rows that do not
correspond, does not change from frame to frame."""


@dataclass(frozen=True, eq=False)
class ReconstructedFrame:
    """The results of one stereo pair.

    Attributes:
        pair: The rectified images.
        disparity: Its disparity, with flying edges removed.
        cloud: Its points in camera axes, filtered.
        warnings: Problems of the images that did not prevent a result.
        rays: Its rays for the occupancy map; None if no map is made.
    """

    pair: RectifiedPair
    disparity: Disparity
    cloud: PointCloud
    warnings: tuple[str, ...] = ()
    rays: RayCloud | None = None

    def unmapped(self) -> ReconstructedFrame:
        """Return the frame with nothing for a map, only for odometry and place recognition."""
        return replace(self, cloud=self.cloud.select(np.zeros(0, np.intp)), rays=None)


class FrameReconstructor:
    """Reconstructs pairs: rectify, inspect, match, remove edges, back-project, filter.

    Args:
        calibration: Calibration of the cameras.
        config: The configuration.
        threads: Threads for the matcher; None = all cores. Does not change results.
        stopwatch: Records the time per stage.
    """

    def __init__(
        self,
        calibration: Rig,
        config: StereoSettings,
        *,
        threads: int | None = None,
        stopwatch: Stopwatch | None = None,
    ) -> None:
        self._config = config
        self._stopwatch = stopwatch or Stopwatch()
        self._rectifier = Rectifier(calibration, config.rectification)
        self._matcher = make_matcher(config.matching.matcher, config.matching, threads)
        self._rough_matcher = HalfSizeMatcher(config.matching, threads=1)

    @property
    def camera(self) -> RectifiedCamera:
        """The rectified camera of all frames."""
        return self._rectifier.camera

    def rectify(self, pair: StereoPair) -> RectifiedPair:
        """Rectify one pair."""
        with self._stopwatch.stage("rectify"):
            return self._rectifier.rectify(pair)

    def match(self, pair: StereoPair) -> tuple[RectifiedPair, Disparity]:
        """Rectify and match one pair, and remove flying edges."""
        rectified = self.rectify(pair)
        return rectified, self._match(rectified)

    def match_roughly(self, pair: StereoPair) -> tuple[RectifiedPair, Disparity]:
        """Rectify one pair, and match it at half size; flying edges stay."""
        rectified = self.rectify(pair)
        with self._stopwatch.stage("match_roughly"):
            return rectified, self._rough_matcher.match(rectified)

    def inspect(self, pair: RectifiedPair) -> tuple[str, ...]:
        """Return warnings about the geometry of a pair; every 50th frame is inspected."""
        if pair.index % _INSPECT_EVERY:
            return ()
        with self._stopwatch.stage("inspect"):
            found = inspect_pair(pair)
        return check_inspection(found, where=f"frame {pair.index}")

    def reconstruct(self, pair: StereoPair) -> ReconstructedFrame:
        """Reconstruct one pair."""
        return self.reconstruct_rectified(self.rectify(pair))

    def reconstruct_rectified(self, rectified: RectifiedPair) -> ReconstructedFrame:
        """Reconstruct one pair that is rectified; see `reconstruct`."""
        config, stage = self._config, self._stopwatch.stage
        disparity = self._match(rectified)
        warnings = self.inspect(rectified)
        with stage("back_project"):
            cloud = back_project(disparity, rectified, config.cloud)
        with stage("filter"):
            cloud = filter_cloud(cloud, config.filters)
        return ReconstructedFrame(rectified, disparity, cloud, warnings)

    def unmatched(self, rectified: RectifiedPair) -> ReconstructedFrame:
        """Return a frame in which nothing is matched: no disparity, no point."""
        return replace(self._nothing, pair=rectified)

    @cached_property
    def _nothing(self) -> ReconstructedFrame:
        shape = (self.camera.height_px, self.camera.width_px)
        grey = np.zeros(shape, np.uint8)
        black = RectifiedPair(grey, grey, self.camera)
        disparity = Disparity.from_values(np.full(shape, np.nan, np.float32))
        cloud = back_project(disparity, black, self._config.cloud)
        return ReconstructedFrame(black, disparity, cloud)

    def _match(self, rectified: RectifiedPair) -> Disparity:
        stage = self._stopwatch.stage
        with stage("match"):
            disparity = self._matcher.match(rectified)
        if not self._config.cloud.remove_flying_edges:
            return disparity
        with stage("edges"):
            return remove_flying_edges(disparity)
