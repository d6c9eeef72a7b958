"""Renders the images of a street drive, with ground truth for each pixel.

All surfaces are Lambertian and the light is static, so a point has the same colour from everywhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import SettingsError
from recon.core.geometry.se3 import as_step, as_transform, invert
from recon.core.open3d_raycasting import RayScene
from recon.core.values import DisparityTruth, RectifiedCamera, StereoPair
from recon.core.values.arrays import Bool, Float32, Float64, Int32, UInt8, freeze
from recon.core.values.camera import disparity_from_depth
from recon.street.kernels.surface import SurfaceHits, SurfaceTable, describe_hits
from recon.street.materials import GAMMA, albedo, sky_colour
from recon.street.shapes import Material, TriangleSoup
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
        self.world, self._kept = world, dict[int, StereoPair]()

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
        """Render only the images; once for a short drive, which is looked at, then mapped."""
        pair = self._kept.get(index) or self._taken(index)
        if len(self._kept) * (pair.left.nbytes + pair.right.nbytes) < _KEPT_BYTES:
            self._kept[index] = pair
        return pair

    def _taken(self, index: int) -> StereoPair:
        # Prepared before the threads start, so that it is done only once.
        views, stage, motion = self.views(index), self.stage, self._motion(index)
        smooth, threads = self.world.settings.smooth_edges, self.world.settings.threads
        # The two views are independent, so the number of threads does not affect the result.
        with ThreadPoolExecutor(max_workers=1 if threads == 1 else 2) as pool:
            images = list(pool.map(lambda view: take_image(stage, view, smooth, motion), views))
        left, right = (self._record(image, index, side) for side, image in enumerate(images))
        time_s = index / self.world.settings.frame_rate_hz
        return StereoPair(left, right, timestamp_s=time_s, index=index, name=f"{index:06d}")

    def depth(self, index: int, *, in_mirrors: bool = True) -> Float32:
        """Return float32 (H, W), true depth of the left image, of what mirrors show; NaN = sky."""
        view = self.views(index)[0]
        directions = view.directions(view.pixels())
        depth = self.stage.depth(view.origin, directions, in_mirrors=in_mirrors)
        return depth.reshape(view.height_px, view.width_px).astype(np.float32)

    def disparity_truth(self, index: int) -> DisparityTruth:
        """Return the true disparity of the left image, without rendering the images."""
        return self._truth(index, self.depth(index))

    def views(self, index: int) -> tuple[View, View]:
        """Return the left and right view of a frame, in street axes."""
        if not 0 <= index < len(self):
            known = f"0 to {len(self) - 1}"
            raise SettingsError("no such frame", got=index, expected=known, hint="raise `frames`")
        return stereo_views(self.world.camera, self.world.T_street_camera[index])

    def _motion(self, index: int) -> Float64:
        """Return the step (6,) of the left camera while the shutter is open around a frame."""
        poses = self.world.T_street_camera
        before, after = max(index - 1, 0), min(index + 1, len(poses) - 1)
        step = as_step(invert(poses[before]) @ poses[after]) / max(after - before, 1)
        return self.world.settings.shutter * step

    def _truth(self, index: int, depth_m: Float32) -> DisparityTruth:
        camera = self.world.camera
        left, right = self.views(index)
        known = np.flatnonzero(np.isfinite(depth_m))
        rays = left.directions(left.pixels()[known])
        xyz = left.origin + depth_m.ravel()[known, None].astype(np.float64) * rays
        hidden = self.stage.rays.blocked(right.origin, xyz - right.origin, far=_SIGHT)
        nonocc = np.zeros(depth_m.size, dtype=np.bool_)
        nonocc[known] = right.inside(right.project(xyz)) & ~hidden
        return DisparityTruth(disparity_from_depth(depth_m, camera), nonocc.reshape(depth_m.shape))

    def _record(self, image: Float64, index: int, side: int) -> UInt8:
        """Apply the sensor model to display values (H, W, 3) in [0, 1]."""
        settings = self.world.settings
        gain, offset_dn = (settings.right_gain, settings.right_offset_dn) if side else (1.0, 0.0)
        levels = 255.0 * gain * image + offset_dn
        if settings.noise_dn > 0:
            rng = np.random.default_rng([settings.seed, 1000, index, side])
            levels += settings.noise_dn * rng.standard_normal(levels.shape)
        return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


_KEPT_BYTES: Final = 64_000_000
_MOMENTS: Final = 7  # of an exposure that are mixed
_FAR_M: Final = 1e6  # depth of the sky
_QUARTERS: Final = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
_CREASE: Final = 0.92  # cosine of the angle between normals, below which there is an edge
_EXPOSURE: Final = 0.9


def take_image(
    stage: Stage, view: View, smooth_edges: bool, motion: Float64 | None = None
) -> Float64:
    """Render one view as float64 (H, W, 3), display values in [0, 1].

    ``motion`` (6,) is the step of the camera meanwhile, which blurs what moves in the image.
    """
    size, pixels = (view.height_px, view.width_px), view.pixels()
    sample = stage.look(view.origin, view.directions(pixels), 1.0 / view.focal_px)
    light = sample.rgb
    if smooth_edges:
        edge = _edges(sample, size)
        quarters = (pixels[edge, None, :] + np.array(_QUARTERS)).reshape(-1, 2)
        four = stage.look(view.origin, view.directions(quarters), 0.5 / view.focal_px)
        light[edge] = four.rgb.reshape(-1, 4, 3).mean(axis=1)
    light = light.reshape(*size, 3)
    if motion is not None and motion.any():
        light = _blurred(light, stage, view, motion)
    return np.asarray(light ** (1.0 / GAMMA))


def _blurred(light: Float64, stage: Stage, view: View, motion: Float64) -> Float64:
    """Return the mean of an image (H, W, 3) over moments of the exposure."""
    pixels = view.pixels()
    directions = view.directions(pixels)
    depth = np.nan_to_num(stage.depth(view.origin, directions), nan=_FAR_M)
    xyz = view.origin + depth[:, None] * directions
    total = np.zeros_like(light)
    for moment in (np.arange(_MOMENTS) + 0.5) / _MOMENTS - 0.5:
        then = replace(view, T_scene_camera=view.T_scene_camera @ as_transform(moment * motion))
        # What a pixel shows then is where it came from, in the image of the middle.
        there = (2.0 * pixels - then.project(xyz)).reshape(*light.shape[:2], 2)
        there = np.nan_to_num(there, nan=-1.0).astype(np.float32)
        total += cv2.remap(light, there, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return total / _MOMENTS


def _edges(sample: Sample, size: tuple[int, int]) -> Bool:
    """Return bool (H·W,), pixels that differ from a neighbour in object, material or normal."""
    label = sample.label.reshape(size)
    normal = sample.normal.reshape(*size, 3)
    edge = np.zeros(size, dtype=np.bool_)
    for a, b in (
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
    ):
        differs = label[a] != label[b]
        differs |= (label[a] >= 0) & (np.einsum("hwx,hwx->hw", normal[a], normal[b]) < _CREASE)
        edge[a] |= differs
        edge[b] |= differs
    return edge.ravel()


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole camera in a scene."""

    T_scene_camera: Float64  # (4, 4)
    focal_px: float
    centre_px: tuple[float, float]  # principal point, column and row
    width_px: int
    height_px: int

    @property
    def origin(self) -> Float64:
        """float64 (3,), the camera centre in the scene."""
        return self.T_scene_camera[:3, 3]

    def pixels(self) -> Float64:
        """Return float64 (H·W, 2), column and row of each pixel, row by row."""
        v, u = np.mgrid[0 : self.height_px, 0 : self.width_px]
        return np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)

    def directions(self, pixels: Float64) -> Float64:
        """Return rays (N, 3) through pixels (N, 2), scene axes, of unit depth."""
        sight = np.ones((len(pixels), 3))
        sight[:, :2] = (pixels - self.centre_px) / self.focal_px
        return np.asarray(sight @ self.T_scene_camera[:3, :3].T)

    def project(self, xyz: Float64) -> Float64:
        """Return pixels (N, 2) of points in the scene; NaN behind the camera."""
        local = (xyz - self.origin) @ self.T_scene_camera[:3, :3]
        depth = np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
        return np.asarray(self.focal_px * local[:, :2] / depth + self.centre_px)

    def inside(self, pixels: Float64) -> Bool:
        """Return bool (N,), True where a position lies within the image."""
        u, v = pixels[:, 0], pixels[:, 1]
        with np.errstate(invalid="ignore"):
            in_u = (u >= -0.5) & (u < self.width_px - 0.5)
            return np.asarray(in_u & (v >= -0.5) & (v < self.height_px - 0.5))


def stereo_views(camera: RectifiedCamera, T_scene_left: Float64) -> tuple[View, View]:
    """Return the left and right view of a rig with its left camera at ``T_scene_left``."""
    T_scene_right = T_scene_left.copy()
    T_scene_right[:3, 3] += camera.baseline_m * T_scene_left[:3, 0]
    places = (T_scene_left, camera.cx_px), (T_scene_right, camera.cx_right_px)
    size = camera.width_px, camera.height_px
    left, right = (View(T, camera.focal_px, (cx, camera.cy_px), *size) for T, cx in places)
    return left, right


_SUN: Final = np.array([1.50, 1.38, 1.18])
_SKY: Final = np.array([0.52, 0.58, 0.68])
_BOUNCES: Final = 2  # mirrors that a ray is followed through
_SIGHT: Final = 1.0 - 1e-4  # fraction of a line of sight that must be free
_SKIN_M: Final = 2e-3  # shadow rays start this far above a surface
_REACH_M: Final = 80.0  # length of shadow rays
_SHELTER_M: Final = 1.0  # a horizontal surface with an object this close above sees little sky


class Sight(NamedTuple):
    """Rays that seem to come from one point, and what they hit."""

    rays: NDArray[np.int64]  # (N,), their numbers
    origin: Float64  # (3,)
    directions: Float64  # (N, 3), of unit depth
    faces: Int32  # (N,), triangles; -1 = the sky

    def select(self, which: Bool) -> Sight:
        return Sight(self.rays[which], self.origin, self.directions[which], self.faces[which])


class Sample(NamedTuple):
    """What rays hit."""

    rgb: Float64  # (N, 3), linear light as exposed, in [0, 1]
    normal: Float64  # (N, 3), shading normal; 0 for the sky
    label: NDArray[np.int64]  # (N,), differs between objects, materials, and shadow and light


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene with its light."""

    soup: TriangleSoup
    table: SurfaceTable  # the triangles, precomputed for hits
    rays: RayScene  # the triangles in the ray caster
    to_sun: Float64  # (3,), unit vector towards the sun
    seed: int  # of grain and clouds

    def depth(self, origin: Float64, directions: Float64, *, in_mirrors: bool = True) -> Float64:
        """Return float64 (N,), depth along rays of unit depth, of what mirrors show; NaN = sky."""
        depth = np.full(len(directions), np.nan)
        for sight in self._sights(origin, directions, _BOUNCES if in_mirrors else 0):
            hit = sight.faces >= 0
            depth[sight.rays[hit]] = self._along(sight)[hit]
        return depth

    def look(self, origin: Float64, directions: Float64, pixel: float) -> Sample:
        """Trace rays of unit depth, where a pixel is ``pixel`` wide, and shade what they hit."""
        sights = list(self._sights(origin, directions, _BOUNCES))
        samples = [self._shade(sight, pixel) for sight in sights]
        order = np.argsort(np.concatenate([sight.rays for sight in sights]))
        return Sample(*(np.concatenate(part)[order] for part in zip(*samples, strict=True)))

    def _sights(
        self, origin: Float64, directions: Float64, bounces: int, beyond: Sight | None = None
    ) -> Iterator[Sight]:
        """Yield rays by the point from which they seem to come: the eye, or its mirror images."""
        # They go on where those of a mirror, ``beyond``, end.
        start, rays = origin, np.arange(len(directions))
        if beyond is not None:
            start, rays = origin + directions * self._along(beyond)[:, None] / _SIGHT, beyond.rays
        seen = Sight(rays, origin, directions, self.rays.first_hit(start, directions))
        mirror = (seen.faces >= 0) & (self.soup.material[seen.faces] == Material.MIRROR)
        if not bounces:
            mirror[:] = False
        yield seen.select(~mirror)
        for part in np.unique(self.soup.part[seen.faces[mirror]]):
            glass = seen.select(mirror & (self.soup.part[seen.faces] == part))
            normal = self.table.normal[glass.faces[0]]
            turn = np.eye(3) - 2.0 * np.outer(normal, normal)
            anchor = self.table.anchor[glass.faces[0]]
            image = anchor + turn @ (origin - anchor)
            yield from self._sights(image, glass.directions @ turn, bounces - 1, glass)

    def _along(self, sight: Sight) -> Float64:
        """Return depth (N,) of the planes of triangles along rays; without meaning for the sky."""
        normal = self.table.normal[sight.faces]
        height = np.einsum("nx,nx->n", self.table.anchor[sight.faces] - sight.origin, normal)
        return np.asarray(height / np.einsum("nx,nx->n", sight.directions, normal))

    def _shade(self, sight: Sight, pixel: float) -> Sample:
        _, origin, directions, faces = sight
        hit = np.flatnonzero(faces >= 0)
        sky = np.flatnonzero(faces < 0)
        rgb, normal = np.empty((len(faces), 3)), np.zeros((len(faces), 3))
        label = np.full(len(faces), -1, dtype=np.int64)
        rgb[sky] = sky_colour(directions[sky], pixel, self.seed)
        met = faces[hit]
        hits = describe_hits(self.table, met, origin, directions[hit], pixel)
        light, lit = self._light(hits)
        rgb[hit] = albedo(self.soup, met, hits, self.seed) * light
        normal[hit] = hits.normal
        part, material = self.soup.part[met], self.soup.material[met]
        label[hit] = (part.astype(np.int64) * 32 + material) * 2 + lit
        return Sample(np.clip(_EXPOSURE * rgb, 0.0, 1.0), normal, label)

    def _light(self, points: SurfaceHits) -> tuple[Float64, Bool]:
        """Return irradiance (N, 3) at points, and whether the sun reaches them."""
        start = points.xyz + _SKIN_M * points.normal
        facing = points.normal @ self.to_sun
        lit = facing > 0
        reach = np.broadcast_to(_REACH_M * self.to_sun, (int(lit.sum()), 3))
        lit[lit] = ~self.rays.blocked(start[lit], reach)
        openness = 0.72 + 0.28 * points.normal[:, 2]
        floor = np.flatnonzero(points.normal[:, 2] > 0.7)
        above = np.broadcast_to([0.0, 0.0, _SHELTER_M], (len(floor), 3))
        openness[floor[self.rays.blocked(start[floor], above)]] *= 0.4
        sun = np.where(lit, facing, 0.0)
        return openness[:, None] * _SKY + sun[:, None] * _SUN, lit


def make_stage(soup: TriangleSoup, to_sun: Float64, seed: int, threads: int = 0) -> Stage:
    """Prepare a scene for rendering, each triangle so that a hit costs only a few products."""
    # The ray caster uses single precision; the planes must be exactly those that it hits.
    corners = soup.vertices.astype(np.float32).astype(np.float64)
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e1, e2)
    squared = np.maximum((normal**2).sum(axis=1, keepdims=True), 1e-24)
    # Gradients of the two barycentric coordinates within the plane.
    gradients = np.stack([np.cross(e2, normal), np.cross(normal, e1)], axis=1)
    gradients /= squared[:, :, None]
    to_uv, to_shading = (
        np.einsum("fkc,fkx->fcx", each[:, 1:] - each[:, :1], gradients)
        for each in (soup.uv, soup.normals)
    )
    start = soup.uv[:, 0].copy(), soup.normals[:, 0].copy()
    unit = normal / np.sqrt(squared)
    table = SurfaceTable(a.copy(), unit, to_uv, start[0], to_shading, start[1])
    return Stage(soup, table, RayScene(soup.vertices, threads), to_sun, seed)
