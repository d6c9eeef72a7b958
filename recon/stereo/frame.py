"""One frame, from the recorded pair to a filtered cloud, with its settings.

Points have their uncertainties; flying edges and outliers are left out.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, SerializeAsAny
from typing_extensions import Self

from recon.core.errors import ShapeError
from recon.core.settings import Length, Settings
from recon.core.values import (
    Disparity,
    PointCloud,
    RayCloud,
    Reason,
    Recorded,
    Rectified,
    RectifiedCamera,
    RectifiedPair,
    Rig,
    StereoPair,
)
from recon.core.values.arrays import frozen_array
from recon.core.work import Stopwatch
from recon.stereo import open3d_clouds
from recon.stereo.kernels import points
from recon.stereo.kernels.finish import count_supporters
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.registry import MatchingSettings, check_matcher
from recon.stereo.observe import Effort, Inspected, Matching, MeasuredDepth, Observer, Support
from recon.stereo.rectify.features import inspect_pair
from recon.stereo.rectify.rectifier import RectificationSettings, Rectifier

_INSPECT_EVERY: Final = 50  # frames: swapped cameras and rows that are off do not change


@dataclass(frozen=True, eq=False)
class ReconstructedFrame:
    """The results of one frame."""

    pair: Rectified  # the rectified images
    disparity: Disparity  # its disparity, with flying edges removed
    cloud: PointCloud  # its points in camera axes, filtered
    warnings: tuple[str, ...] = ()  # problems of the images that did not prevent a result
    rays: RayCloud | None = None  # its rays for the occupancy map; None if no map is made
    epipolar_error_px: float | None = None  # epipolar error; NaN = unknown, None = not measured
    support: Support | None = None  # that both images belong together; None: not judged

    def unmapped(self) -> ReconstructedFrame:
        """Return the frame with nothing for a map, only for odometry and place recognition."""
        return replace(self, cloud=self.cloud.select(np.zeros(0, np.intp)), rays=None)


class FrameReconstructor:
    """Reconstructs frames: rectify, inspect, observe, remove edges, back-project, filter."""

    def __init__(
        self,
        calibration: Rig,
        config: StereoSettings,
        *,
        threads: int | None = None,  # of the matcher; results do not depend on them
        stopwatch: Stopwatch | None = None,
        check_epipolar: bool = False,  # of every frame: the cameras move against each other
    ) -> None:
        self._config, self._check_epipolar = config, check_epipolar
        self._stopwatch = stopwatch or Stopwatch()
        rectifier = Rectifier(calibration, config.rectification)
        self.camera = rectifier.camera  # the rectified camera of all frames
        self._matching = Matching(rectifier, config.matching, threads)
        self._depth = MeasuredDepth()
        # Whether views that show something new are matched by a matcher of their own.
        self.matches_keyframes = "match_keyframes" in self._matching.matchers

    def rectify(self, pair: Recorded) -> Rectified:
        with self._stopwatch.stage("rectify"):
            return self._observer(pair).rectify(pair)

    def match(self, pair: Recorded) -> tuple[Rectified, Disparity]:
        """Rectify and match one pair, and remove flying edges."""
        rectified = self.rectify(pair)
        return rectified, self._observe(rectified)

    def match_roughly(self, pair: Recorded) -> tuple[Rectified, Disparity]:
        """Rectify one pair, and match it at half size; flying edges stay."""
        rectified = self.rectify(pair)
        with self._stopwatch.stage("match_roughly"):
            return rectified, self._observer(rectified).observe(rectified, "match_roughly")

    def inspect(self, pair: Rectified) -> Inspected:
        """Return warnings about a pair, and what supports that its images belong together."""
        with self._stopwatch.stage("inspect"):
            return self._observer(pair).inspect(pair)

    def reconstruct(self, pair: Recorded) -> ReconstructedFrame:
        """Reconstruct one pair, and inspect it."""
        rectified = self.rectify(pair)
        return self._frame_of(rectified, self._observe(rectified), *self.inspect(rectified))

    def reconstruct_rectified(self, rectified: Rectified) -> ReconstructedFrame:
        """Reconstruct one pair of a drive that is rectified; every 50th is inspected."""
        inspected = ((), None) if rectified.index % _INSPECT_EVERY else self.inspect(rectified)
        frame = self._frame_of(rectified, self._observe(rectified), *inspected)
        if not (self._check_epipolar and isinstance(rectified, RectifiedPair)):
            return frame
        return replace(frame, epipolar_error_px=inspect_pair(rectified).epipolar_error_px)

    def reconstruct_keyframe(self, frame: ReconstructedFrame) -> ReconstructedFrame:
        """Reconstruct a frame again, by the matcher of keyframes."""
        disparity = self._observe(frame.pair, "match_keyframes")
        return self._frame_of(frame.pair, disparity, frame.warnings)

    def _frame_of(
        self,
        rectified: Rectified,
        disparity: Disparity,
        warnings: tuple[str, ...],
        support: Support | None = None,
    ) -> ReconstructedFrame:
        config, stage = self._config, self._stopwatch.stage
        with stage("back_project"):
            cloud = back_project(disparity, rectified, config.cloud)
        with stage("filter"):
            cloud = filter_cloud(cloud, config.filters)
        return ReconstructedFrame(rectified, disparity, cloud, warnings, support=support)

    def unmatched(self, rectified: Rectified) -> ReconstructedFrame:
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

    def _observer(self, one: Recorded | Rectified) -> Observer:
        return self._matching if isinstance(one, StereoPair | RectifiedPair) else self._depth

    def _observe(self, rectified: Rectified, effort: Effort = "match") -> Disparity:
        """Return the disparity of a view, without flying edges."""
        with self._stopwatch.stage(effort):
            disparity = self._observer(rectified).observe(rectified, effort)
        if not self._config.cloud.remove_flying_edges:
            return disparity
        with self._stopwatch.stage("edges"):
            return remove_flying_edges(disparity)


_NORMALS_RADIUS_PX: Final = 3  # half width of the window that gives a point its normal


class CloudSettings(Settings):
    """Which pixels become points."""

    remove_flying_edges: bool = True
    """Drop pixels that float between a foreground and its background. Turn it off to see what the
    matcher found."""
    min_range_m: float = Length(0.1, ge=0, le=1000000.0)
    """Nearest depth kept. Set it to hide a bonnet or gripper."""
    max_range_m: float | None = Length(30.0, ge=1e-06, le=1000000.0, reach=True)
    """Farthest depth kept; none = no limit. The error of a depth grows with its square."""
    max_relative_sigma: float | None = Field(0.1, ge=1e-06, le=1000000.0)
    """Largest standard deviation of a depth kept, as a fraction of it; none = no limit. Smaller for
    fewer, more certain points."""
    inferred: bool = False
    """Points also of pixels whose disparity is not measured, but that of planes around them; they
    are marked. Turn it on where a surface without holes counts more than a true one."""


def back_project(
    disparity: Disparity, pair: Rectified, settings: CloudSettings, *, normals: bool = True
) -> PointCloud:
    """Return points of the pixels that were measured, ``Z = f·b / (d + doffs)``, in row order.

    The cloud is in camera axes, with colours, ``sigma_m`` (``sigma_z = Z²·sigma_d / (f·b)``),
    confidence and, if asked for, normals towards the camera, which take as long as the rest. With
    ``settings.inferred`` it has the pixels that were inferred, too, and says which they are.
    """
    if disparity.values.shape != pair.left.shape:
        raise ShapeError(
            "disparity and image differ in size",
            got=f"disparity {disparity.values.shape}",
            expected=f"{pair.left.shape}",
        )
    if not settings.inferred:
        disparity = disparity.only_measured()
    confidence = disparity.confidence
    if settings.inferred:  # its sign says through the kernel which pixels are
        signed = np.where(disparity.inferred, -confidence, confidence)
        confidence = frozen_array("confidence", signed, np.float32, (None, None))
    maps = points.Maps(
        values=disparity.values,
        confidence=confidence,
        sigma=disparity.sigma_px,
        colours=pair.left[:, :, None] if pair.left_rgb is None else pair.left_rgb,
        usable=np.zeros((0, 0), np.bool_) if pair.valid is None else pair.valid,
    )
    found = points.make_points(maps, _rules(pair.camera, settings, normals))
    return PointCloud(
        xyz=found.xyz,
        rgb=found.colours,
        normals=found.normals if normals else None,
        sigma_m=found.sigma,
        confidence=np.abs(found.confidence),
        inferred=np.signbit(found.confidence).astype(np.uint8) if settings.inferred else None,
        frame="camera",
    )


def _rules(camera: RectifiedCamera, settings: CloudSettings, normals: bool) -> points.PointRules:
    return points.PointRules(
        focal=float(camera.focal_px),
        cx=float(camera.cx_px),
        cy=float(camera.cy_px),
        fb=float(camera.focal_px * camera.baseline_m),
        doffs=float(camera.doffs_px),
        nearest=settings.min_range_m,
        farthest=_or_infinity(settings.max_range_m),
        relative_sigma=_or_infinity(settings.max_relative_sigma),
        stride=1,
        radius=_NORMALS_RADIUS_PX if normals else 0,
    )


def _or_infinity(limit: float | None) -> float:
    # The largest float, not infinity: 0 · inf is NaN, and infinite depths must be rejected.
    return sys.float_info.max if limit is None else limit


_RADIUS_PX: Final = 2  # half width of the window
_MAX_GRADIENT: Final = 1.0  # largest disparity gradient of a matchable surface, pixels per pixel
_TOLERANCE_PX: Final = 0.5  # matching noise allowed on top of the gradient
_MIN_SUPPORT: Final = 0.36  # fraction of the window that must lie on the surface of its centre


def remove_flying_edges(disparity: Disparity) -> Disparity:
    """Drop pixels that too few of their neighbours could share a surface with (`Reason.EDGE`).

    Depth noise grows with distance, disparity noise does not, so disparities are tested. A
    surface that both cameras see changes by less than one pixel per pixel (the disparity
    gradient limit); a neighbour within that cone supports the centre. At a clean step
    each side keeps half of its window, at a convex corner a third, while the mixed pixels on the
    ramp between the sides keep little more than their own column. Pixels without a disparity
    support none; the image is mirrored at its border.

    Ref: Burt & Julesz, "A disparity gradient limit for binocular fusion", Science 208 (1980).
    """
    r = _RADIUS_PX
    padded = cv2.copyMakeBorder(disparity.values, r, r, r, r, cv2.BORDER_REFLECT_101)
    away = np.arange(-r, r + 1)
    limits = _TOLERANCE_PX + _MAX_GRADIENT * np.hypot(away[:, None], away)
    support = count_supporters(padded, limits.astype(np.float32))
    return disparity.reject(support < _MIN_SUPPORT * (2 * r + 1) ** 2, Reason.EDGE)


_STATISTICAL_SIGMAS: Final = 2.0  # of the mean distance: limit of the statistical filter
_RADIUS_NEIGHBOURS: Final = 2  # that a point needs within the radius: fewer are an island


class FilterSettings(Settings):
    """Which filters are applied to the cloud of one frame, in this order; none turns one off."""

    voxel_m: float | None = Field(None, ge=1e-06, le=1000000.0)
    """Edge of the voxels that points are averaged in. Set it for fewer points."""
    statistical_neighbours: int | None = Field(None, ge=1, le=100)
    """Neighbours of the statistical outlier filter, which drops points that are farther from them
    than most. For one pair: fusion cleans the clouds of a drive, and the filter is slow."""


# For the cloud of one pair, whose scale is unknown: no filter with a length in metres.
ANY_SCALE: Final = FilterSettings(statistical_neighbours=20)


def filter_cloud(cloud: PointCloud, settings: FilterSettings) -> PointCloud:
    """Thin a cloud, which makes the searches for neighbours cheap, then drop its outliers.

    In a voxel every attribute is averaged (``sigma_m`` too: the errors of neighbouring pixels are
    not independent), and normals are renormalised.
    """
    if settings.voxel_m is not None and len(cloud):
        cloud = voxel_downsample(cloud, settings.voxel_m)
    if settings.statistical_neighbours is not None:
        keep = open3d_clouds.statistical_inliers(
            cloud.xyz, settings.statistical_neighbours, _STATISTICAL_SIGMAS
        )
        cloud = cloud.select(keep)
    return cloud


def drop_islands(cloud: PointCloud, radius_m: float | NDArray[Any] | None) -> PointCloud:
    """Drop points with too few others within a radius; None = keep all."""
    if radius_m is None:
        return cloud
    return cloud.select(open3d_clouds.radius_inliers(cloud.xyz, _RADIUS_NEIGHBOURS, radius_m))


def voxel_downsample(cloud: PointCloud, voxel_m: float) -> PointCloud:
    """Return one point per voxel, the mean of its points in every attribute that has one."""
    fused = [(each, values) for each, values in cloud.attributes if each.fused is not None]
    columns = [each.averaged(values) for each, values in fused]
    packed = np.concatenate([np.zeros((len(cloud), 0), np.float32), *columns], axis=1)
    xyz, means = open3d_clouds.voxel_downsample(cloud.xyz, packed, voxel_m)
    ends = np.cumsum([each.columns for each, _ in fused])
    parts = zip(fused, np.split(means, ends[:-1], axis=1), strict=False)
    found: dict[str, Any] = {each.name: each.of_means(part) for (each, _), part in parts}
    return PointCloud(xyz, frame=cloud.frame, **found)


class StereoSettings(Settings):
    """Everything that determines the cloud of one frame."""

    rectification: RectificationSettings = RectificationSettings()
    matching: SerializeAsAny[MatchingSettings] = MatchingSettings()  # with those of plug-ins
    cloud: CloudSettings = CloudSettings()
    filters: FilterSettings = FilterSettings()

    def with_matcher(self, matcher: str | Matcher | None) -> Self:
        """Return the settings with another matcher, by name or as an object; None = unchanged.

        ``config.yaml`` has the name of an object only, so such a run is repeated from Python.
        """
        if matcher is None:
            return self
        check_matcher(matcher)
        matching = self.matching.model_copy(update={"matcher": matcher})
        return self.model_copy(update={"matching": matching})
