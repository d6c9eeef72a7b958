"""Furnished rooms seen through equidistant lenses, with exact depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import yaml

from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import CameraIntrinsics, StereoCalibration
from recon.io.images.image import write_image
from recon.stereo.rectify.rectifier import RectifyingTurns
from recon.street.render import Stage, View, make_stage, take_image
from recon.street.shapes import Material, Paint, TriangleSoup, boxes, cylinder, merge, move, quads

# Camera axes (x right, y down, z forward) in room axes (x forward, y left, z up).
T_ROOM_FORWARD = make_transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))


def fisheye_rig(
    field_deg: float,
    size: tuple[int, int],
    coefficients: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
    centre: tuple[float, float] = (1.5, -2.0),
) -> StereoCalibration:
    """A rig that sees ``field_deg`` across its width, 10 cm apart, the right camera pitched 2.7°.

    Args:
        field_deg: Field of view across the image width, if the polynomial is 1.
        size: Width and height.
        coefficients: Kannala-Brandt polynomial of the left lens; the right one is a little off.
        centre: Offset of the principal points from the image centre.
    """
    width, height = size
    focal = width / 2 / np.radians(field_deg / 2)

    def camera(scale: float, shift: float) -> CameraIntrinsics:
        x, y = (width - 1) / 2 + centre[0] + shift, (height - 1) / 2 + centre[1] - shift
        K = np.array([[focal * scale, 0, x], [0, focal * scale, y], [0, 0, 1]])
        return CameraIntrinsics(K, np.array(coefficients) * scale, width, height, "fisheye")

    T = make_transform(exp_so3(np.radians([2.7, 0.4, -0.3])), np.array([-0.101, 0.0019, 0.0012]))
    return StereoCalibration(camera(1.0, 0.0), camera(0.996, -1.2), T)


@dataclass(frozen=True, eq=False)
class LensView(View):
    """A raw camera in a room; its rays may point backwards."""

    camera: CameraIntrinsics | None = None

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit rays (N, 3) in room axes, by inverting the polynomial with Newton's method."""
        assert self.camera is not None
        K = self.camera.matrix
        ahead = np.polynomial.Polynomial(
            [0.0, 1.0, *np.ravel([(0.0, k) for k in self.camera.distortion])]
        )
        plane = (pixels - K[:2, 2]) / np.diag(K)[:2]
        radius = np.linalg.norm(plane, axis=1)
        angle = radius.copy()
        for _ in range(50):
            angle -= (ahead(angle) - radius) / ahead.deriv()(angle)
        sideways = plane * (np.sin(angle) / np.maximum(radius, 1e-12))[:, None]
        rays = np.column_stack([sideways, np.cos(angle)])
        return np.asarray(rays @ self.T_scene_camera[:3, :3].T)


def view_of(camera: CameraIntrinsics, T_room_camera: np.ndarray) -> LensView:
    K = camera.matrix
    size = (camera.width_px, camera.height_px)
    return LensView(T_room_camera, float(K[0, 0]), (K[0, 2], K[1, 2]), *size, camera)


@cache
def room(seed: int = 1) -> Stage:
    """A room of 8 by 6 by 3 m around the origin at eye level, with furniture and two pillars."""
    rng = np.random.default_rng(seed)
    low, high = np.array([-2.5, -3.0, -1.4]), np.array([5.5, 3.0, 1.6])
    x, y, z = np.diag(high - low)
    walls = [(low, x, z), (low, y, z), (low + y, x, z), (low + x, y, z)]
    soups: list[TriangleSoup] = [
        quads(p, u, v, Paint(Material.POSTER, tuple(rng.uniform(0.3, 0.9, 3)), 10 + n))
        for n, (p, u, v) in enumerate(walls)
    ]
    soups.append(quads(low, x, y, Paint(Material.PAVING, (0.6, 0.5, 0.4), 20)))
    # Open to the sky in the middle, so that there is light.
    soups += [
        quads(low + z + n * 0.8 * y, x, 0.2 * y, Paint(Material.BRICK, (0.7, 0.6, 0.5), 30 + n))
        for n in range(2)
    ]
    for n in range(9):
        corner = rng.uniform((0.8, -2.8, -1.4), (4.5, 2.0, -1.4))
        if abs(corner[1]) < 0.9:
            corner[1] += 1.8 * np.sign(corner[1])
        paint = Paint(Material.POSTER, tuple(rng.uniform(0.2, 0.9, 3)), 40 + n)
        soups.append(boxes(corner, corner + rng.uniform(0.4, 1.2, 3), paint))
    for n, at in enumerate([(2.4, 1.3, -1.4), (3.2, -1.2, -1.4)]):
        pillar = cylinder((0.2, 0.2), 3.0, Paint(Material.POSTER, (0.8, 0.7, 0.3), 60 + n))
        soups.append(move(pillar, make_transform(np.eye(3), np.array(at))))
    return make_stage(merge(soups), np.array([0.2, 0.3, 0.93]), seed, threads=2)


def poses(frames: int, step_m: float = 0.05) -> list[np.ndarray]:
    """``T_room_left``: ahead with a slight turn, swinging sideways."""
    found = []
    for n in range(frames):
        turn = exp_so3(np.array([0.0, 0.004 * n, 0.0]))
        at = np.array([-1.0 + step_m * n, 0.1 * np.sin(0.25 * n), 0.0])
        found.append(make_transform(T_ROOM_FORWARD[:3, :3] @ turn, at))
    return found


def photograph(rig: StereoCalibration, T_room_left: np.ndarray, seed: int = 1) -> list[np.ndarray]:
    """Left and right raw image in [0, 1], float64 (H, W), with noise of half a grey level."""
    images = []
    T_room_right = T_room_left @ invert(rig.T_right_left)
    for side, (camera, T) in enumerate(((rig.left, T_room_left), (rig.right, T_room_right))):
        light = take_image(room(seed), view_of(camera, T), smooth_edges=True).mean(axis=2)
        noise = np.random.default_rng([seed, side]).standard_normal(light.shape)
        images.append(np.clip(light + noise / 510, 0, 1) * _image_circle(camera))
    return images


def _image_circle(camera: CameraIntrinsics) -> np.ndarray:
    """bool (H, W), False in corners beyond 100 degrees, where a lens lets no light through."""
    K = camera.matrix
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
    radius = np.hypot((u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1])
    return np.asarray(radius < np.radians(100))


def true_depth(turns: RectifyingTurns, T_room_left: np.ndarray, seed: int = 1) -> np.ndarray:
    """float64 (H, W), depth of the rectified left view in metres; NaN = sky."""
    camera = turns.camera
    T = T_room_left @ make_transform(turns.R_left.T, np.zeros(3))
    size = (camera.width_px, camera.height_px)
    view = View(T, camera.focal_px, (camera.cx_px, camera.cy_px), *size)
    depth = room(seed).depth(view.origin, view.directions(view.pixels()))
    return np.asarray(depth).reshape(size[::-1])


def write_euroc_room(
    folder: Path, rig: StereoCalibration, frames: int, levels: Callable[[np.ndarray], np.ndarray]
) -> Path:
    """A drive in EuRoC's layout, ``sensor.yaml`` as TUM VI has it; ``levels`` makes pixels."""
    for n, T in enumerate(poses(frames)):
        stamp = 1_520_530_308_199_447_626 + n * 50_000_000
        for side, image in enumerate(photograph(rig, T)):
            view = folder / "mav0" / f"cam{side}"
            write_image(view / "data" / f"{stamp}.png", levels(image))
            with (view / "data.csv").open("a") as lines:
                lines.write(f"{stamp},{stamp}.png\n")
    cameras = ((rig.left, np.eye(4)), (rig.right, invert(rig.T_right_left)))
    for side, (camera, T_body_camera) in enumerate(cameras):
        K = camera.matrix
        content = {
            "sensor_type": "camera",
            "T_BS": {"cols": 4, "rows": 4, "data": T_body_camera.ravel().tolist()},
            "resolution": [camera.width_px, camera.height_px],
            "camera_model": "pinhole",
            "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
            "distortion_model": "equidistant",
            "distortion_coefficients": camera.distortion.tolist(),
        }
        path = folder / "mav0" / f"cam{side}" / "sensor.yaml"
        path.write_text("#Camera\n" + yaml.safe_dump(content))
    return folder
