"""Visual odometry, corrected by kiss-icp where ICP is more certain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from recon.core.geometry.se3 import apply, as_step, as_transform, invert, orthonormalise
from recon.core.values import PointCloud
from recon.core.values.arrays import Float64
from recon.odometry.covariance import covariance_of, step_covariance
from recon.odometry.gate import (
    MIN_OVERLAP,
    Correction,
    Verdict,
    best_covariance,
    icp_covariance,
    icp_may_help,
    judge,
)
from recon.odometry.kiss_icp import IcpAlignment, KissIcp, KissIcpOptions
from recon.odometry.points import select_points
from recon.odometry.prior import MotionPrior
from recon.odometry.protocol import (
    OdometryFrame,
    OdometryHealth,
    OdometryResult,
    finite_in,
    pose_in,
)
from recon.odometry.settings import OdometrySettings
from recon.odometry.surfaces import describe_surfaces, fit_surfaces
from recon.odometry.visual import VisualEstimate, VisualOdometry

_SOURCE_SHARE: Final = 0.8
"""Points farther than this share of the range are not aligned, but go into the map."""

_VOXEL_M: Final = 0.3
"""Edge of a voxel of the map of ICP."""

_THRESHOLD_M: Final = 0.3
"""Scale of the robust kernel; points pair up to thrice as far."""

_LOST_THRESHOLD_M: Final = 1.0
"""That scale where there is no visual prior."""

_ITERATIONS: Final = 50
"""ICP steps at most."""

_CONVERGENCE: Final = 1e-3
"""Length of a step below which it is the last."""

_MIN_POINTS: Final = 300
"""Frames with fewer points keep the visual pose."""

_SURFACE_M: Final = 1.0
"""Edge of the cells in which surfaces are fitted to the map."""

_LOST_SIGMA_M: Final = 0.05
"""Standard deviation of an extrapolated translation, times the number of frames since the last
visual motion."""

_LOST_SIGMA_DEG: Final = 0.3
"""That of an extrapolated rotation, likewise."""

_ICP_EVERY: Final = 4
"""Frames from one run of ICP to the next; in between it runs only where the visual motion is
uncertain."""

_OFFSET_FRAMES: Final = 30
"""Frames over which the mean ICP correction is estimated, and then subtracted: a constant one comes
from the bias of stereo depth with range, not from the motion."""


@dataclass(frozen=True, eq=False)
class _Prior:
    """The pose before ICP.

    Attributes:
        T_world_camera: float64 (4, 4), the last pose moved on by the visual motion.
        covariance: float64 (6, 6), of a step in its axes.
        visual: The result of the visual odometry.
    """

    T_world_camera: Float64
    covariance: Float64
    visual: VisualEstimate

    @property
    def seen(self) -> bool:
        """Whether the motion was measured, not extrapolated."""
        return self.visual.information is not None


class FusedOdometry:
    """Visual odometry as the prior of every frame, and gated corrections by kiss-icp.

    Args:
        settings: Range of the points.
        prior: How the camera moved by other means.
    """

    def __init__(self, settings: OdometrySettings, prior: MotionPrior | None = None) -> None:
        self._settings = settings
        self._visual = VisualOdometry(prior)
        self._icp = KissIcp(
            KissIcpOptions(
                max_range_m=settings.max_range_m,
                source_range_m=_SOURCE_SHARE * settings.max_range_m,
                voxel_m=_VOXEL_M,
                iterations=_ITERATIONS,
                convergence=_CONVERGENCE,
            )
        )
        self._T_visual = np.eye(4)
        self._T_world_camera = np.eye(4)
        self._offset = np.zeros(6)
        self._measured = 0
        self._lost = 0
        self._mapped = False
        self._frames = 0
        # Until ICP has run, it is assumed to be as good as it can be.
        self._icp_covariance = best_covariance()

    def register(self, frame: OdometryFrame) -> OdometryResult:
        """Register the next frame.

        ICP takes as long as the visual odometry and rarely improves it, so it runs every few frames
        and whenever the prior is uncertain. Without a visual motion the last one is continued and
        ICP may correct it; without either, the health says that the pose rests on no measurement,
        and the map is not updated.
        """
        prior = self._prior(self._visual.track(frame))
        due = self._frames % _ICP_EVERY == 0
        self._frames += 1
        if due or not prior.seen or self._icp_may_help(prior):
            result = self._with_icp(prior, frame)
        else:
            result = OdometryResult(prior.T_world_camera, prior.visual.result.health)
        self._T_visual = prior.visual.result.T_world_camera
        self._T_world_camera = result.T_world_camera
        return result

    def state(self) -> dict[str, Any]:
        """Return everything that later poses depend on."""
        return {
            "visual": self._visual.state(),
            "icp": self._icp.state(),
            "T_visual": self._T_visual,
            "T_world_camera": self._T_world_camera,
            "offset": self._offset,
            "icp_covariance": self._icp_covariance,
            "counts": [self._measured, self._lost, self._frames],
            "mapped": self._mapped,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`."""
        self._visual.restore(state["visual"])
        self._icp.restore(state["icp"])
        self._T_visual = pose_in(state, "T_visual")
        self._T_world_camera = pose_in(state, "T_world_camera")
        self._offset = finite_in(state, "offset", (6,))
        self._icp_covariance = finite_in(state, "icp_covariance", (6, 6))
        self._measured, self._lost, self._frames = map(int, state["counts"])
        self._mapped = bool(state["mapped"])

    def _icp_may_help(self, prior: _Prior) -> bool:
        """Return whether ICP, if as certain as the last time, would change the prior."""
        return icp_may_help(prior.covariance, self._icp_covariance)

    def _with_icp(self, prior: _Prior, frame: OdometryFrame) -> OdometryResult:
        """Return the prior with ICP's correction; the frame is added to ICP's map."""
        points = select_points(frame, self._settings.max_range_m)
        result = self._corrected(prior, points)
        if result.health.ok and len(points) >= _MIN_POINTS:
            self._icp.update(points.xyz, result.T_world_camera)
            self._mapped = True
        return result

    def _prior(self, visual: VisualEstimate) -> _Prior:
        self._lost = 0 if visual.information is not None else self._lost + 1
        T = self._T_world_camera @ invert(self._T_visual) @ visual.result.T_world_camera
        if visual.information is None:
            sigmas = self._lost * np.array([_LOST_SIGMA_M, _LOST_SIGMA_DEG])
            return _Prior(orthonormalise(T), step_covariance(*sigmas.tolist()), visual)
        covariance = covariance_of(visual.information)
        return _Prior(orthonormalise(T), covariance, visual)

    def _corrected(self, prior: _Prior, points: PointCloud) -> OdometryResult:
        """Return the prior, moved by the part of ICP's correction that passes the gate."""
        health = prior.visual.result.health
        if not self._mapped or len(points) < _MIN_POINTS:
            note = "no map for ICP yet" if not self._mapped else "too few points for ICP"
            health = replace(health, icp_points=len(points), notes=(*health.notes, note))
            return OdometryResult(prior.T_world_camera, health)
        alignment = self._align(prior, points)
        correction = self._measure(prior, alignment)
        verdict = judge(correction, self._offset, prior.covariance)
        self._learn_offset(prior, correction)
        self._icp_covariance = icp_covariance(correction.after)
        T = orthonormalise(prior.T_world_camera @ as_transform(verdict.step))
        return OdometryResult(T, _health(health, alignment, correction, verdict))

    def _align(self, prior: _Prior, points: PointCloud) -> IcpAlignment:
        """Return ICP from the prior; from an extrapolated one with a wider threshold first."""
        T = prior.T_world_camera
        if not prior.seen:
            T = self._icp.align(points.xyz, T, _LOST_THRESHOLD_M).T_world_camera
        return self._icp.align(points.xyz, T, _THRESHOLD_M)

    def _measure(self, prior: _Prior, alignment: IcpAlignment) -> Correction:
        """Return what ICP would change, and how the frame fits the map before and after."""
        T_prior_icp = invert(prior.T_world_camera) @ alignment.T_world_camera
        near = apply(invert(prior.T_world_camera), self._icp.map_points())
        surfaces = describe_surfaces(near, _SURFACE_M)
        return Correction(
            step=as_step(T_prior_icp),
            before=fit_surfaces(alignment.source, surfaces),
            after=fit_surfaces(apply(T_prior_icp, alignment.source), surfaces),
        )

    def _learn_offset(self, prior: _Prior, correction: Correction) -> None:
        """Average ICP's corrections of good priors: their mean is a bias, not a motion."""
        if prior.seen and correction.after.overlap >= MIN_OVERLAP:
            self._measured += 1
            share = 1.0 / min(self._measured, _OFFSET_FRAMES)
            self._offset = (1.0 - share) * self._offset + share * correction.step


def _health(
    visual: OdometryHealth, alignment: IcpAlignment, correction: Correction, verdict: Verdict
) -> OdometryHealth:
    return replace(
        visual,
        ok=visual.ok or verdict.accepted,
        icp_points=len(alignment.source),
        overlap=correction.after.overlap,
        residual_m=correction.after.residual_m,
        correction_m=float(np.linalg.norm(correction.step[:3])),
        correction_deg=float(np.rad2deg(np.linalg.norm(correction.step[3:]))),
        accepted=verdict.accepted,
        notes=(*visual.notes, *([verdict.note] if verdict.note else [])),
    )
