"""A rendered drive that is kept: rendering takes far longer than what most tests do with it."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from recon.core.values import RectifiedCamera, StereoPair, Trajectory
from recon.core.values.arrays import Float64
from recon.sources.source import StereoSource
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene

RIG = {"width_px": 320, "height_px": 120, "focal_px": 180.0, "smooth_edges": False}
"""Large enough that places are recognised."""


class Film(StereoSource):
    """Some frames of a rendered drive, in any order, perhaps changed; each is rendered once."""

    description = "a rendered street"

    def __init__(
        self, pairs: list[StereoPair], camera: RectifiedCamera, T_world_camera: Float64
    ) -> None:
        self.name, self.calibration, self.pairs = "film", camera, pairs
        self.trajectory = Trajectory(T_world_camera, 0.1 * np.arange(len(pairs)))

    def __len__(self) -> int:
        return len(self.pairs)

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        times = enumerate(self.pairs[start:], start)
        return (replace(pair, timestamp_s=0.1 * n, index=n) for n, pair in times)

    def taken(
        self, which: slice, change: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> "Film":
        """Return some of its frames, each image changed."""
        chosen = self.pairs[which]
        if change is not None:
            chosen = [replace(p, left=change(p.left), right=change(p.right)) for p in chosen]
        poses = self.trajectory.T_world_camera[which].copy()
        return Film(chosen, self.calibration, poses)


def film(scene: StreetScene) -> Film:
    source = SyntheticSource(scene)
    return Film(list(source), source.calibration, source.trajectory.T_world_camera)
