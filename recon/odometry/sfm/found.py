"""What structure from motion found: models of pairs, and an odometry that gives their poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from recon.core.errors import RegistrationError
from recon.core.summary import Figures
from recon.core.text import counted
from recon.core.values.arrays import Float64, Int64
from recon.odometry.health import name_frames
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult


@dataclass(frozen=True, eq=False)
class Model:
    """Pairs whose poses beside each other are known."""

    frames: Int64  # (M,), their numbers in the source, ascending
    T_world_camera: Float64  # (M, 4, 4), of the rectified left camera; the first is the identity
    points: Int64  # (M,), points of the model that the left image shows
    # (M, 2), standard deviations of position (metres) and rotation (degrees), given the points
    sigmas: Float64
    reprojection_px: float  # mean error of all features


@dataclass(frozen=True)
class SfmFigures(Figures):
    """How many pairs structure from motion placed, and how well."""

    pairs: int
    registered: int  # in the largest model
    models: Sequence[int]  # pairs in each
    reprojection_px: float  # mean error in the largest


@dataclass(frozen=True, eq=False)
class FoundPoses:
    """What structure from motion found of the pairs of a source."""

    pairs: int  # number of pairs of the source
    models: tuple[Model, ...]  # the largest first; no pair is in two of them

    def figures(self) -> SfmFigures:
        sizes = [len(model.frames) for model in self.models]
        return SfmFigures(self.pairs, sizes[0], sizes, self.models[0].reprojection_px)

    def warnings(self) -> list[str]:
        """Return what the user should know, the most important first."""
        largest, *others = self.models
        missing = self.pairs - len(largest.frames)
        if not missing:
            return []
        apart = "; ".join(
            f"{counted(len(one.frames), 'pair')} among themselves ({_named(one)})" for one in others
        )
        what = f"{missing} of {counted(self.pairs, 'pair')} could not be placed beside the others"
        return [f"{what}, and are not in the map{f'; placed are {apart}' if apart else ''}"]


def _named(model: Model) -> str:
    return name_frames(model.frames.tolist())


class FoundOdometry:
    """An odometry whose poses are those that structure from motion found; the largest model counts.

    Pairs that are not in it get the pose of one before, and are not to be trusted.

    Args:
        found: What was found; None = comes with `restore`.
    """

    def __init__(self, found: FoundPoses | None = None) -> None:
        self._found = found
        self._next = 0

    @property
    def found(self) -> FoundPoses:
        if self._found is None:
            raise RegistrationError("structure from motion has found nothing yet")
        return self._found

    def register(self, frame: OdometryFrame) -> OdometryResult:
        model, index = self.found.models[0], self._next
        self._next += 1
        at = max(0, int(np.searchsorted(model.frames, index, side="right")) - 1)
        T_world_camera = model.T_world_camera[at]
        if model.frames[at] != index:
            notes = ("structure from motion could not place it",)
            return OdometryResult(T_world_camera, OdometryHealth(False, skipped=True, notes=notes))
        points, (sigma_m, sigma_deg) = int(model.points[at]), model.sigmas[at].tolist()
        health = OdometryHealth(
            tracks=points, inliers=points, sigma_m=sigma_m, sigma_deg=sigma_deg,
            reprojection_px=model.reprojection_px,
        )  # fmt: skip
        return OdometryResult(T_world_camera, health)

    def state(self) -> dict[str, Any]:
        models = {str(number): vars(model) for number, model in enumerate(self.found.models)}
        return {"next": self._next, "pairs": self.found.pairs, "models": models}

    def restore(self, state: dict[str, Any]) -> None:
        models = tuple(Model(**state["models"][key]) for key in sorted(state["models"], key=int))
        self._found, self._next = FoundPoses(int(state["pairs"]), models), int(state["next"])
