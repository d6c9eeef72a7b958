"""Renders the images of a street drive, with ground truth for each pixel."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from recon.core.errors import SettingsError
from recon.core.geometry.projection import disparity_from_depth
from recon.core.values import DisparityTruth, StereoPair
from recon.core.values.arrays import Float32, Float64, UInt8, freeze
from recon.street.image import View, record, stereo_views, take_image
from recon.street.stage import Stage, make_stage
from recon.street.street import StreetWorld


@dataclass(frozen=True, eq=False)
class SyntheticFrame:
    """One stereo pair with its exact ground truth."""

    pair: StereoPair
    depth_m: Float32  # (H, W), depth of the left image; NaN = sky
    truth: DisparityTruth  # of the left image, NaN = sky; and which points the right camera sees
    T_world_camera: Float64  # (4, 4), pose of the left camera; that of frame 0 is the identity
    #: (4,), ``a·x + b·y + c·z + d`` is the height above the road of a point in camera axes.
    ground_plane: Float64

    def __post_init__(self) -> None:
        freeze(self, "depth_m", np.float32, self.truth.values.shape)
        freeze(self, "T_world_camera", np.float64, (4, 4))
        freeze(self, "ground_plane", np.float64, (4,))


class StreetCamera:
    """The rig in a street; renders frames in any order."""

    def __init__(self, world: StreetWorld) -> None:
        self.world = world

    def __len__(self) -> int:
        return self.world.settings.frames

    def __iter__(self) -> Iterator[SyntheticFrame]:
        return (self.render(index) for index in range(len(self)))

    @cached_property
    def stage(self) -> Stage:
        """The lit scene, prepared on first use."""
        settings = self.world.settings
        return make_stage(self.world.soup, self.world.to_sun, settings.seed, settings.threads)

    def render(self, index: int) -> SyntheticFrame:
        """Render one stereo pair with its ground truth."""
        depth = self.depth(index)
        return SyntheticFrame(
            pair=self.pair(index),
            depth_m=depth,
            truth=self._truth(index, depth),
            T_world_camera=self.world.trajectory.T_world_camera[index],
            ground_plane=self.world.ground_plane(index),
        )

    def pair(self, index: int) -> StereoPair:
        """Render only the images."""
        # Prepared before the threads start, so that it is done only once.
        views, stage = self.views(index), self.stage
        smooth, threads = self.world.settings.smooth_edges, self.world.settings.threads
        # The two views are independent, so the number of threads does not affect the result.
        with ThreadPoolExecutor(max_workers=1 if threads == 1 else 2) as pool:
            images = list(pool.map(lambda view: take_image(stage, view, smooth), views))
        left, right = (self._record(image, index, side) for side, image in enumerate(images))
        time_s = index / self.world.settings.frame_rate_hz
        return StereoPair(left, right, timestamp_s=time_s, index=index, name=f"{index:06d}")

    def depth(self, index: int) -> Float32:
        """Return float32 (H, W), true depth of the left image in metres; NaN = sky."""
        view = self.views(index)[0]
        depth = self.stage.depth(view.origin, view.directions(view.pixels()))
        return depth.reshape(view.height_px, view.width_px).astype(np.float32)

    def disparity_truth(self, index: int) -> DisparityTruth:
        """Return the true disparity of the left image, without rendering the images."""
        return self._truth(index, self.depth(index))

    def views(self, index: int) -> tuple[View, View]:
        """Return the left and right view of a frame, in street axes."""
        if not 0 <= index < len(self):
            expected = f"0 to {len(self) - 1}"
            raise SettingsError(
                "no such frame", got=index, expected=expected, hint="raise `frames`"
            )
        return stereo_views(self.world.camera, self.world.T_street_camera[index])

    def _truth(self, index: int, depth_m: Float32) -> DisparityTruth:
        """Return the disparity, and whether the right camera sees each point."""
        camera = self.world.camera
        left, right = self.views(index)
        known = np.flatnonzero(np.isfinite(depth_m))
        rays = left.directions(left.pixels()[known])
        xyz = left.origin + depth_m.ravel()[known, None].astype(np.float64) * rays
        seen = right.inside(right.project(xyz)) & self.stage.sees(right.origin, xyz)
        nonocc = np.zeros(depth_m.size, dtype=np.bool_)
        nonocc[known] = seen
        return DisparityTruth(disparity_from_depth(depth_m, camera), nonocc.reshape(depth_m.shape))

    def _record(self, image: Float64, index: int, side: int) -> UInt8:
        """Apply the sensor model of one camera to an image."""
        settings = self.world.settings
        return record(
            image,
            gain=settings.right_gain if side else 1.0,
            offset_dn=settings.right_offset_dn if side else 0.0,
            noise_dn=settings.noise_dn,
            key=[settings.seed, 1000, index, side],
        )
