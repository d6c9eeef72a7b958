"""One frame, from the recorded pair to a filtered cloud, with its settings and its figures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from typing_extensions import Self

from recon.core.settings import Settings
from recon.core.text import counted
from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    PointCloud,
    RayCloud,
    Reason,
    RectifiedCamera,
    RectifiedPair,
    Rig,
    StereoPair,
    TriangleMesh,
)
from recon.run.progress import Stopwatch
from recon.stereo.cloud.back_project import (
    CloudSettings,
    FilterSettings,
    back_project,
    filter_cloud,
    remove_flying_edges,
)
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.registry import MatchingSettings, check_matcher, make_matcher, searched
from recon.stereo.match.sad import HalfSizeMatcher
from recon.stereo.rectify.features import check_inspection, inspect_pair
from recon.stereo.rectify.rectifier import RectificationSettings, Rectifier

_INSPECT_EVERY: Final = 50  # frames: swapped cameras and rows that are off do not change


@dataclass(frozen=True, eq=False)
class ReconstructedFrame:
    """The results of one stereo pair."""

    pair: RectifiedPair  # the rectified images
    disparity: Disparity  # its disparity, with flying edges removed
    cloud: PointCloud  # its points in camera axes, filtered
    warnings: tuple[str, ...] = ()  # problems of the images that did not prevent a result
    rays: RayCloud | None = None  # its rays for the occupancy map; None if no map is made

    def unmapped(self) -> ReconstructedFrame:
        """Return the frame with nothing for a map, only for odometry and place recognition."""
        return replace(self, cloud=self.cloud.select(np.zeros(0, np.intp)), rays=None)


class FrameReconstructor:
    """Reconstructs pairs: rectify, inspect, match, remove edges, back-project, filter."""

    def __init__(
        self,
        calibration: Rig,
        config: StereoSettings,
        *,
        threads: int | None = None,  # of the matcher; results do not depend on them
        stopwatch: Stopwatch | None = None,
    ) -> None:
        self._config = config
        self._stopwatch = stopwatch or Stopwatch()
        self._rectifier = Rectifier(calibration, config.rectification)
        self._matcher = make_matcher(config.matching.matcher, config.matching, threads)
        self._rough_matcher = HalfSizeMatcher(searched(config.matching), threads=1)

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


class StereoSettings(Settings):
    """Everything that determines the cloud of one frame."""

    rectification: RectificationSettings = RectificationSettings()
    matching: MatchingSettings = MatchingSettings()
    cloud: CloudSettings = CloudSettings()
    filters: FilterSettings = FilterSettings()
    """Filters of the cloud of one frame, in this order; none turns one off. Fusion thins and cleans
    the clouds of a drive anyway."""

    def with_matcher(self, matcher: str | Matcher | None) -> Self:
        """Return the settings with another matcher, by name or as an object; None = unchanged.

        ``config.yaml`` has the name of an object only, so such a run is repeated from Python.
        """
        if matcher is None:
            return self
        check_matcher(matcher)
        matching = self.matching.model_copy(update={"matcher": matcher})
        return self.model_copy(update={"matching": matching})


@dataclass(frozen=True, eq=False)
class PairRun:
    """Results of a run, from which its report is made."""

    name: str  # display name of the pair
    config: StereoSettings  # the configuration
    pair: RectifiedPair  # the rectified images
    disparity: Disparity  # their disparity
    summary: dict[str, Any]  # the figures of ``summary.json``
    #: The points in camera axes, or None if only the disparity was requested.
    cloud: PointCloud | None = None
    mesh: TriangleMesh | None = None  # the surface in camera axes, or None
    truth: DisparityTruth | None = None  # true disparity, or None
    metrics: DisparityMetrics | None = None  # errors against it, or None
    warnings: tuple[str, ...] = ()  # problems that did not stop the run

    def __repr__(self) -> str:
        parts = (self.disparity, self.cloud, self.mesh)
        made = ", ".join(repr(part) for part in parts if part is not None)
        return f"PairRun({self.name!r}, {made}, {counted(len(self.warnings), 'warning')})"


def disparity_figures(disparity: Disparity) -> dict[str, Any]:
    """Return size, share of pixels for each reason, and median of a disparity, ready for JSON."""
    found = disparity.values[disparity.valid]
    shares = disparity.reason_shares
    return {
        "width_px": disparity.values.shape[1],
        "height_px": disparity.values.shape[0],
        "valid_percent": 100.0 * float(disparity.valid.mean()),
        "reasons_percent": {r.name.lower(): 100.0 * shares.get(r, 0.0) for r in Reason},
        "disparity_median_px": float(np.median(found)) if len(found) else None,
    }


def cloud_figures(frame: ReconstructedFrame) -> dict[str, Any]:
    """Return the number of points, median depth and camera of a frame, ready for JSON."""
    camera, z = frame.pair.camera, frame.cloud.xyz[:, 2]
    return {
        "points": len(frame.cloud),
        "depth_median_m": float(np.median(z)) if len(z) else None,
        "focal_px": camera.focal_px,
        "field_of_view_deg": camera.field_of_view_deg,
        "cx_px": camera.cx_px,
        "cy_px": camera.cy_px,
        "baseline_m": camera.baseline_m,
        "doffs_px": camera.doffs_px,
    }
