"""A street of textured planes: images and disparity from any pose, exact."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import Disparity, Reason, RectifiedCamera, RectifiedPair
from recon.odometry.protocol import OdometryFrame, OdometryResult

See = Callable[..., OdometryFrame]
CAMERA = RectifiedCamera(260.0, 199.5, 79.5, 199.5, 0.5, 400, 160)
# 0.5 m a frame along a gentle bend.
STEP = make_transform(exp_so3(np.array([0.0, 0.01, 0.0])), np.array([0.0, 0.0, 0.5]))

# Normal, offset (n·x = c) and the two axes of the texture: ground, side walls, ceiling, end wall.
PLANES = (
    ((0, 1, 0), 1.6, (0, 2)),
    ((1, 0, 0), -4.0, (1, 2)),
    ((1, 0, 0), 5.0, (1, 2)),
    ((0, 1, 0), -4.0, (0, 2)),
    ((0, 0, 1), 40.0, (0, 1)),
)


def _texture() -> np.ndarray:
    rng = np.random.default_rng(7)
    total = np.zeros((1024, 1024))
    for size in (3.0, 8.0, 20.0):
        noise = cv2.GaussianBlur(rng.normal(size=total.shape), (0, 0), size)
        total += noise / noise.std()
    return np.clip(128 + 35 * total, 0, 255).astype(np.float32)


TEXTURE = _texture()
TEXELS_PER_M = 24.0


def _render(T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey image, averaged over 3 by 3 rays in a pixel, and depth, seen from a pose."""
    thirds = [(du, dv) for du in (-1 / 3, 0.0, 1 / 3) for dv in (-1 / 3, 0.0, 1 / 3)]
    seen = [_cast(T_world_camera, shift) for shift in thirds]
    return np.rint(np.mean([grey for grey, _ in seen], axis=0)).astype(np.uint8), seen[4][1]


def _cast(T_world_camera: np.ndarray, shift: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Grey values and depth along one ray in each pixel."""
    v, u = np.mgrid[0 : CAMERA.height_px, 0 : CAMERA.width_px].astype(np.float64)
    x = (u + shift[0] - CAMERA.cx_px) / CAMERA.focal_px
    y = (v + shift[1] - CAMERA.cy_px) / CAMERA.focal_px
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ T_world_camera[:3, :3].T
    start = T_world_camera[:3, 3]
    depth = np.full(x.shape, np.inf)
    grey = np.zeros(x.shape, np.float32)
    for number, (normal, offset, axes) in enumerate(PLANES):
        n = np.asarray(normal, dtype=np.float64)
        with np.errstate(divide="ignore"):
            t = (offset - start @ n) / (rays @ n)
        nearer = (t > 0.1) & (t < depth)
        hit = start + rays[nearer] * t[nearer][:, None]
        texel = (hit[:, axes] * TEXELS_PER_M + 311.0 * number).astype(np.float32) % 1023
        colour = cv2.remap(TEXTURE, texel[None, :, 0], texel[None, :, 1], cv2.INTER_LINEAR)
        grey[nearer], depth[nearer] = colour[0], t[nearer]
    return grey, depth


def steps(count: int, step: np.ndarray = STEP) -> np.ndarray:
    return np.stack([np.linalg.matrix_power(step, n) for n in range(count)])


def off_m(result: OdometryResult, truth: np.ndarray) -> float:
    return float(np.linalg.norm((invert(truth) @ result.T_world_camera)[:3, 3]))


def make_frame(grey: np.ndarray, values: np.ndarray, index: int = 0) -> OdometryFrame:
    """A frame; odometry on exact disparities does not use the right image."""
    values = values.astype(np.float32)
    valid = np.isfinite(values)
    sigma_px = np.where(valid, np.float32(0.1), np.float32(np.nan))
    reason = np.where(valid, np.uint8(Reason.VALID), np.uint8(Reason.LOW_TEXTURE))
    pair = RectifiedPair(grey, grey, CAMERA, timestamp_s=0.1 * index, index=index)
    return OdometryFrame(pair, Disparity(values, valid.astype(np.float32), sigma_px, reason))


@pytest.fixture(scope="session")
def camera():
    return CAMERA


@pytest.fixture(scope="session")
def see():
    def see_from(T_world_camera: np.ndarray, index: int = 0) -> OdometryFrame:
        grey, depth = _render(T_world_camera)
        return make_frame(grey, CAMERA.focal_px * CAMERA.baseline_m / depth, index)

    return see_from


@pytest.fixture(scope="session")
def see_both(see):
    """See the street from a pose with both cameras."""

    def see_from(T_world_camera: np.ndarray, index: int = 0) -> OdometryFrame:
        frame = see(T_world_camera, index)
        T_left_right = make_transform(np.eye(3), np.array([CAMERA.baseline_m, 0.0, 0.0]))
        right = _render(T_world_camera @ T_left_right)[0]
        return replace(frame, pair=replace(frame.pair, right=right))

    return see_from


@pytest.fixture(scope="session")
def blind():
    """A frame that shows nothing: one grey level, no disparity."""

    def blind_frame(level: int = 0, index: int = 0) -> OdometryFrame:
        shape = (CAMERA.height_px, CAMERA.width_px)
        return make_frame(np.full(shape, level, np.uint8), np.full(shape, np.nan), index)

    return blind_frame


@pytest.fixture(scope="session")
def street_poses():
    """float64 (12, 4, 4); the first is the identity."""
    return steps(12)


@pytest.fixture(scope="session")
def street(see, street_poses):
    return tuple(see(T, index) for index, T in enumerate(street_poses))
