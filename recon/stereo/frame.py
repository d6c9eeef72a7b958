"""One frame, from the recorded pair to a filtered cloud: the stateless part of the pipeline."""

from __future__ import annotations

from dataclasses import dataclass
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

    @property
    def camera(self) -> RectifiedCamera:
        """The rectified camera of all frames."""
        return self._rectifier.camera

    def match(self, pair: StereoPair) -> tuple[RectifiedPair, Disparity]:
        """Rectify and match one pair, and remove flying edges."""
        config, stage = self._config, self._stopwatch.stage
        with stage("rectify"):
            rectified = self._rectifier.rectify(pair)
        with stage("match"):
            disparity = self._matcher.match(rectified)
        if config.cloud.remove_flying_edges:
            with stage("edges"):
                disparity = remove_flying_edges(disparity)
        return rectified, disparity

    def unmatched(self, pair: StereoPair) -> ReconstructedFrame:
        """Return a frame that is rectified alone: every disparity is unknown, the cloud empty."""
        with self._stopwatch.stage("rectify"):
            rectified = self._rectifier.rectify(pair)
        nothing = np.full(rectified.left.shape, np.nan, np.float32)
        disparity = Disparity.from_values(nothing)
        return ReconstructedFrame(
            rectified, disparity, back_project(disparity, rectified, self._config.cloud)
        )

    def inspect(self, pair: RectifiedPair) -> tuple[str, ...]:
        """Return warnings about the geometry of a pair; every 50th frame is inspected.

        Raises:
            CalibrationError: Left and right are swapped.
        """
        if pair.index % _INSPECT_EVERY:
            return ()
        with self._stopwatch.stage("inspect"):
            found = inspect_pair(pair)
        return check_inspection(found, where=f"frame {pair.index}")

    def reconstruct(self, pair: StereoPair) -> ReconstructedFrame:
        """Reconstruct one pair.

        Raises:
            CalibrationError: Left and right are swapped.
        """
        config, stage = self._config, self._stopwatch.stage
        rectified, disparity = self.match(pair)
        warnings = self.inspect(rectified)
        with stage("back_project"):
            cloud = back_project(disparity, rectified, config.cloud)
        with stage("filter"):
            cloud = filter_cloud(cloud, config.filters)
        return ReconstructedFrame(rectified, disparity, cloud, warnings)
