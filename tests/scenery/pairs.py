"""Rendered pairs of hard scenes as a camera takes them, with exact truth, and where there is none.

Example: python -m tests.scenery.pairs FOLDER
"""

import json
import sys
from dataclasses import asdict, dataclass
from enum import IntEnum
from pathlib import Path

import cv2
import numpy as np

from recon.core.values import DisparityTruth, RectifiedCamera, RectifiedPair, StereoPair
from recon.core.values.arrays import Float64, UInt8
from recon.core.values.camera import disparity_from_depth
from recon.io.images.disparity import write_pfm
from recon.io.images.image import write_image
from recon.stereo.rectify.rectifier import Rectifier
from recon.street.materials import GAMMA
from recon.street.render import Sample, Stage, View, make_stage, stereo_views, take_image
from recon.street.shapes import merge
from tests.scenery.hard_scenes import HARD_SCENES, HardScene, hard_scene

_SIZE = (640, 480)
_FOCAL = 0.86  # in image widths
_BLUR_PX = 0.55  # of the lens, standard deviation
_READ_DN, _SHOT_DN = 0.8, 0.013  # of the sensor: standard deviation, and variance a grey level
_DARK_DN = 4.0  # of what is seen there, nothing is left
_GLASS = 0.3  # fraction of the light that a pane reflects
_AMBIENT = 0.35  # of a room with lamps


class Kind(IntEnum):
    """What the left camera sees in a pixel."""

    SURFACE, SKY, DARK, MIRROR = range(4)


@dataclass(frozen=True, eq=False)
class HardPair:
    """A pair with its truth.

    ``truth`` is NaN where there is nothing to be seen (sky, and what the light does not reach),
    and where it is not decided (in mirrors and behind panes that reflect).
    """

    name: str
    left: UInt8  # (H, W, 3)
    right: UInt8
    camera: RectifiedCamera
    truth: DisparityTruth
    kind: UInt8  # (H, W), a `Kind`

    @property
    def pair(self) -> RectifiedPair:
        """Both images, as matchers take them."""
        return Rectifier(self.camera).rectify(StereoPair(self.left, self.right))


class _LitStage(Stage):
    """A scene in the light of its lamps, and under its sky."""

    scene: HardScene

    def look(self, origin: Float64, directions: Float64, pixel: float) -> Sample:
        sample = super().look(origin, directions, pixel)
        rgb, sky = sample.rgb, sample.label < 0
        if self.scene.clear:
            rgb[sky] = _clear_sky(directions[sky], self.to_sun)
        if self.scene.lamps:
            depth = self.depth(origin, directions)
            rgb *= self._light_of_lamps(origin + depth[:, None] * directions, sample.normal)[
                :, None
            ]
            rgb[sky] = 0.0
        return sample._replace(rgb=np.clip(rgb, 0.0, 1.0))

    def _light_of_lamps(self, xyz: Float64, normal: Float64) -> Float64:
        """Return the light (N,) at points: it falls with the square of the distance."""
        total = np.full(len(xyz), _AMBIENT if len(self.scene.lamps) > 1 else 0.0)
        for x, y, z, strength in self.scene.lamps:
            way = np.array([x, y, z]) - xyz
            away = np.linalg.norm(way, axis=1)
            facing = np.einsum("nx,nx->n", way, normal) / away
            seen = np.nan_to_num(xyz), np.nan_to_num(way)
            hidden = self.rays.blocked(seen[0] + 1e-3 * normal, seen[1])
            reach = strength * np.where(hidden, 0.0, np.maximum(facing, 0.0)) / (away**2 + 0.3)
            if self.scene.cone_rad is not None:
                ahead = np.clip(-way @ self.scene.T_scene_left[:3, 2] / away, -1.0, 1.0)
                reach *= np.exp(-((np.arccos(ahead) / self.scene.cone_rad) ** 4))
            total += reach
        return np.asarray(np.nan_to_num(total))


def _clear_sky(directions: Float64, to_sun: Float64) -> Float64:
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    blue, white = np.array([[0.42, 0.60, 0.84], [0.84, 0.88, 0.93]]) ** GAMMA
    haze = np.exp(-np.clip(unit[:, 2:], 0.0, 1.0) / 0.3)
    off = np.arccos(np.clip(unit @ to_sun, -1.0, 1.0))[:, None]
    glow = 1.3 * np.exp(-((off / 0.09) ** 2)) + 0.45 * np.exp(-off / 0.35)
    return np.asarray(blue + (white - blue) * haze + glow * [1.0, 0.95, 0.85])


def hard_pair(name: str, seed: int, scale: float = 1.0) -> HardPair:
    """Render one of `HARD_SCENES`, in images of 640 by 480 pixels times a scale."""
    scene = hard_scene(name, seed)
    width, height = (round(scale * k) for k in _SIZE)
    focal, cx, cy = _FOCAL * width, 0.5 * (width - 1), 0.5 * (height - 1)
    camera = RectifiedCamera(focal, cx, cy, cx, scene.baseline_m, width, height)
    views = stereo_views(camera, scene.T_scene_left)
    stage = _stage(scene, seed)
    light = [_exposed(stage, view) for view in views]
    kind = np.zeros((height, width), np.uint8)
    if scene.panes is not None:
        behind = _stage(scene, seed, with_panes=True)
        light = [
            (1 - _GLASS) * one + _GLASS * _exposed(behind, view)
            for one, view in zip(light, views, strict=True)
        ]
        stage = behind
    depth = _depth(stage, views[0])
    kind[depth != _depth(stage, views[0], in_mirrors=False)] = Kind.MIRROR
    dark = 255.0 * light[0].max(axis=2) ** (1 / GAMMA) < _DARK_DN
    kind[dark] = Kind.DARK
    outside = np.isnan(_depth(stage, views[0], in_mirrors=False))
    kind[outside] = Kind.DARK if scene.lamps else Kind.SKY
    left, right = (_record(one, [seed, 7, side]) for side, one in enumerate(light))
    return HardPair(name, left, right, camera, _truth(stage, views, camera, depth, kind), kind)


def _stage(scene: HardScene, seed: int, *, with_panes: bool = False) -> _LitStage:
    soup = merge([scene.soup, scene.panes]) if with_panes and scene.panes else scene.soup
    stage = _LitStage(**vars(make_stage(soup, scene.to_sun, seed)))
    object.__setattr__(stage, "scene", scene)
    return stage


def _exposed(stage: Stage, view: View) -> Float64:
    """Return linear light (H, W, 3), the mean over the area of each pixel, as the lens blurs it."""
    cx, cy = view.centre_px
    size = 2 * view.width_px, 2 * view.height_px
    fine = View(view.T_scene_camera, 2 * view.focal_px, (2 * cx + 0.5, 2 * cy + 0.5), *size)
    light = take_image(stage, fine, smooth_edges=False) ** GAMMA
    blurred = cv2.GaussianBlur(light, (0, 0), 2 * _BLUR_PX)
    return np.asarray(blurred.reshape(view.height_px, 2, view.width_px, 2, 3).mean(axis=(1, 3)))


def _record(light: Float64, seed: list[int]) -> UInt8:
    """Return what a sensor makes of linear light: noise that grows with the light, grey levels."""
    levels = 255.0 * light ** (1 / GAMMA)
    noise = np.random.default_rng(seed).standard_normal(levels.shape)
    levels += noise * np.sqrt(_READ_DN**2 + _SHOT_DN * levels)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def _depth(stage: Stage, view: View, *, in_mirrors: bool = True) -> Float64:
    depth = stage.depth(view.origin, view.directions(view.pixels()), in_mirrors=in_mirrors)
    return depth.reshape(view.height_px, view.width_px)


def _truth(
    stage: Stage, views: tuple[View, View], camera: RectifiedCamera, depth: Float64, kind: UInt8
) -> DisparityTruth:
    left, right = views
    known = np.flatnonzero(np.isfinite(depth) & (kind == Kind.SURFACE))
    xyz = left.origin + depth.ravel()[known, None] * left.directions(left.pixels()[known])
    hidden = stage.rays.blocked(right.origin, xyz - right.origin, far=0.999)
    nonocc = np.zeros(depth.size, np.bool_)
    nonocc[known] = right.inside(right.project(xyz)) & ~hidden
    values = np.where(kind == Kind.SURFACE, disparity_from_depth(depth, camera), np.nan)
    return DisparityTruth(values.astype(np.float32), nonocc.reshape(depth.shape))


def relit(image: UInt8, kind: str, rng: np.random.Generator) -> UInt8:
    """Return an image (H, W) or (H, W, 3) in other light: gradient, gamma or spot."""
    height, width = image.shape[:2]
    y, x = np.mgrid[0 : 1 : height * 1j, 0 : 1 : width * 1j]
    levels = image / 255.0
    if kind == "gamma":
        levels = levels ** float(rng.choice([0.6, 1.7]))
    elif kind == "gradient":
        way = rng.uniform(0.0, 2.0 * np.pi)
        ramp = 0.8 + 0.7 * ((x - 0.5) * np.cos(way) + (y - 0.5) * np.sin(way))
        levels = levels * ramp.reshape(height, width, *[1] * (image.ndim - 2))
    else:
        cx, cy = rng.uniform(0.25, 0.75, 2)
        spot = 0.55 + 0.9 * np.exp(-(((x - cx) / 0.22) ** 2 + ((y - cy) / 0.22) ** 2))
        levels = levels * spot.reshape(height, width, *[1] * (image.ndim - 2))
    return np.clip(np.rint(255.0 * levels), 0, 255).astype(np.uint8)


def write_pair(folder: Path, pair: HardPair) -> None:
    """Write the images, the truth (NaN = none), the kinds of pixels and the camera."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in (("left", pair.left), ("right", pair.right), ("none", pair.kind)):
        write_image(folder / f"{name}.png", image)
    write_pfm(folder / "truth.pfm", pair.truth.values)
    write_image(folder / "nonocc.png", np.where(pair.truth.nonocc, 255, 0).astype(np.uint8))
    (folder / "camera.json").write_text(json.dumps(asdict(pair.camera)))


if __name__ == "__main__":
    for number in (0, 1):
        for scene_name in HARD_SCENES:
            write_pair(Path(sys.argv[1]) / f"{scene_name}{number}", hard_pair(scene_name, number))
