"""Calibration boards seen through lenses of known distortion: ground truth for calibration."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice, product
from typing import Final, Literal

import numpy as np

from recon.core.geometry.se3 import apply, exp_so3, make_transform
from recon.core.values import CameraIntrinsics, LensModel, StereoCalibration
from recon.core.values.arrays import Float64, UInt8
from recon.core.values.board import CalibrationBoard
from recon.rig.calibrate.patterns import dark_polygons
from recon.stereo.rectify.lens import project_raw, rays_of

Lens = Literal["radtan", "rational", "fisheye"]

# Per square or step; corners lie on the borders between texels, and the cells of tags with gaps of
# 0.3 do. Borders of circles are staircases.
_TEXELS: Final = {"chess": 48, "charuco": 48, "aprilgrid": 52, "circles": 192, "acircles": 192}
_WHITE, _DARK, _WALL = 225.0, 28.0, 120.0
_MARGIN_PX: Final = 6.0
_OFFSETS: Final = (np.arange(4) + 0.5) / 4 - 0.5  # of rays in a pixel
_MAX_TILT_RAD: Final = math.radians(50)
_LENSES: Final[dict[Lens, tuple[LensModel, float, tuple[float, ...]]]] = {
    "radtan": ("pinhole", 0.8, (-0.28, 0.09, 8e-4, -6e-4)),
    "rational": ("pinhole", 0.7, (0.12, -0.04, 4e-4, -3e-4, 0.002, 0.42, 0.05, 0.004)),
    "fisheye": ("fisheye", 0.38, (0.03, -0.012, 0.004, -6e-4)),
}


@dataclass(frozen=True, eq=False)
class BoardView:
    """One position of the board, and the true pixels (N, 2) of its corners."""

    T_left_board: Float64
    left_px: Float64
    right_px: Float64

    def noisy(self, sigma_px: float, rng: np.random.Generator) -> "BoardView":
        """The view with Gaussian noise added to every pixel coordinate."""
        left, right = (p + rng.normal(0, sigma_px, p.shape) for p in (self.left_px, self.right_px))
        return BoardView(self.T_left_board, left, right)


def board_rig(
    lens: Lens = "radtan", width_px: int = 640, height_px: int = 480
) -> StereoCalibration:
    """A rig of two slightly different, slightly misaligned cameras."""
    model, focal, coefficients = _LENSES[lens]
    distortion = np.array(coefficients)

    def camera(scale: float, cx: float, cy: float, bend: float) -> CameraIntrinsics:
        f = scale * focal * width_px
        matrix = np.array([[f, 0, cx * width_px], [0, 1.002 * f, cy * height_px], [0, 0, 1]])
        return CameraIntrinsics(matrix, bend * distortion, width_px, height_px, model)

    turn, offset = np.array([0.008, -0.02, 0.012]), 0.12 * np.array([-1.0, 0.02, 0.015])
    T = make_transform(exp_so3(turn), offset)
    return StereoCalibration(camera(1.0, 0.507, 0.489, 1.0), camera(1.006, 0.494, 0.508, 0.95), T)


def place_boards(
    rig: StereoCalibration, board: CalibrationBoard, count: int, seed: int = 0
) -> list[BoardView]:
    rng = np.random.default_rng(seed)
    tried = (_try_place(rig, board, rng) for _ in range(400 * count))
    return list(islice((view for view in tried if view is not None), count))


class BoardRenderer:
    """Renders a board on white paper as seen by one camera, with 4 x 4 rays per pixel."""

    def __init__(self, camera: CameraIntrinsics, board: CalibrationBoard) -> None:
        self._camera, self._board = camera, board
        v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
        rays = rays_of(camera, np.stack([u.ravel(), v.ravel()], axis=1))[:, :2]
        self._rays = rays.reshape(camera.height_px, camera.width_px, 2)
        # Rays vary smoothly, so linear interpolation within a pixel has no visible error.
        self._by_v = np.asarray(np.gradient(self._rays, axis=0))
        self._by_u = np.asarray(np.gradient(self._rays, axis=1))
        self._texture, self._low = _texture(board)
        self._texels = _TEXELS[board.kind]

    def render(self, T_camera_board: Float64, sigma_grey: float = 0.0, seed: int = 0) -> UInt8:
        """uint8 (H, W), the board at a pose in front of a grey wall, with noise of that sigma."""
        grey = np.full((self._camera.height_px, self._camera.width_px), _WALL)
        box = self._box(T_camera_board)
        total = np.zeros(grey[box].shape)
        rays, by_u, by_v = (each[box] for each in (self._rays, self._by_u, self._by_v))
        for dv, du in product(_OFFSETS, repeat=2):
            total += self._sample(T_camera_board, rays + du * by_u + dv * by_v)
        grey[box] = total / len(_OFFSETS) ** 2
        if sigma_grey:
            grey += np.random.default_rng(seed).normal(0, sigma_grey, grey.shape)
        return np.asarray(np.clip(np.rint(grey), 0, 255), dtype=np.uint8)

    def _box(self, T_camera_board: Float64) -> tuple[slice, slice]:
        """Rows and columns that the paper may cover; all if part of it is behind the camera."""
        pixels = project_raw(self._camera, apply(T_camera_board, _outline(self._board, margin=1.0)))
        if not np.isfinite(pixels).all():
            return slice(None), slice(None)
        low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 2, 0)
        high = np.maximum(np.ceil(pixels.max(axis=0)).astype(int) + 3, 0)
        return slice(low[1], high[1]), slice(low[0], high[0])

    def _sample(self, T_camera_board: Float64, rays: Float64) -> Float64:
        """Grey level of the board where rays (H, W, 2) hit it, of the wall elsewhere."""
        # A point of the board is R[:, 0] x + R[:, 1] y + t; the scale of the ray cancels.
        H = np.linalg.inv(T_camera_board[:3, [0, 1, 3]])
        with np.errstate(invalid="ignore", divide="ignore"):
            w = rays @ H[2, :2] + H[2, 2]
            x = (rays @ H[0, :2] + H[0, 2]) / w / self._board.square_m
            y = (rays @ H[1, :2] + H[1, 2]) / w / self._board.square_m
            column = np.floor((x - self._low[0]) * self._texels)
            row = np.floor((y - self._low[1]) * self._texels)
        rows, columns = self._texture.shape
        hit = (w > 0) & (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        picked = np.where(hit, row * columns + column, 0).astype(np.int64)
        return np.where(hit, self._texture.ravel()[picked], _WALL)


def render_views(
    rig: StereoCalibration, board: CalibrationBoard, views: Sequence[BoardView]
) -> list[tuple[UInt8, UInt8]]:
    """Left and right image, uint8 (H, W), of each view."""
    left, right = (BoardRenderer(camera, board) for camera in (rig.left, rig.right))
    return [
        (
            left.render(view.T_left_board, 2.0, 2 * number),
            right.render(rig.T_right_left @ view.T_left_board, 2.0, 2 * number + 1),
        )
        for number, view in enumerate(views)
    ]


def _texture(board: CalibrationBoard) -> tuple[Float64, Float64]:
    """Grey levels of the paper, and where its upper left corner is; two squares are its margin."""
    outlines = dark_polygons(board) / board.square_m
    low = np.floor(outlines.min(axis=(0, 1))) - 1.0
    columns, rows = np.ceil(outlines.max(axis=(0, 1)) - low).astype(int) + 1
    texels = _TEXELS[board.kind]
    texture = np.full((rows * texels, columns * texels), _WHITE)
    for outline in (outlines - low) * texels:
        (x0, y0), (x1, y1) = (
            np.rint(outline.min(axis=0)).astype(int),
            np.rint(outline.max(axis=0)).astype(int),
        )
        part = texture[y0:y1, x0:x1]
        if len(outline) == 4:
            part[:] = _DARK
        else:
            y, x = np.mgrid[y0:y1, x0:x1] + 0.5
            cx, cy = outline.mean(axis=0)
            part[np.hypot(x - cx, y - cy) < np.ptp(outline[:, 0]) / 2] = _DARK
    return texture, low


def _try_place(
    rig: StereoCalibration, board: CalibrationBoard, rng: np.random.Generator
) -> BoardView | None:
    """One random pose, or None if a corner is outside an image."""
    left = rig.left
    aim = rng.uniform((0.05, 0.05), (0.95, 0.95)) * (left.width_px, left.height_px)
    ray = rays_of(left, aim[None])[0]
    if not np.isfinite(ray).all():
        return None
    reach = max(board.size_m) * left.matrix[0, 0] / left.width_px
    centre = ray / np.linalg.norm(ray) * reach * (0.8 + 2.2 * rng.uniform() ** 2)
    axis, tilt = rng.uniform(0, 2 * math.pi), _MAX_TILT_RAD * math.sqrt(rng.uniform())
    turn = exp_so3(tilt * np.array([math.cos(axis), math.sin(axis), 0.0]))
    roll = exp_so3(np.array([0.0, 0.0, rng.uniform(-0.25, 0.25)]))
    R = _facing(ray) @ turn @ roll
    T = make_transform(R, centre - R @ board.corners_m.mean(axis=0))
    xyz = apply(T, np.concatenate([board.corners_m, _outline(board)]))
    seen = project_raw(left, xyz), project_raw(rig.right, apply(rig.T_right_left, xyz))
    corners = len(board.corners_m)
    limit = np.array([left.width_px, left.height_px]) - 1 - _MARGIN_PX
    if not all(((px >= _MARGIN_PX) & (px <= limit)).all() for px in seen):
        return None
    return BoardView(T, seen[0][:corners], seen[1][:corners])


def _facing(ray: Float64) -> Float64:
    """float64 (3, 3), the smallest rotation that turns the z axis along a ray."""
    towards = ray / np.linalg.norm(ray)
    axis = np.cross([0.0, 0.0, 1.0], towards)
    sine = float(np.linalg.norm(axis))
    return exp_so3(axis / max(sine, 1e-12) * math.atan2(sine, towards[2]))


def _outline(board: CalibrationBoard, margin: float = 0.0) -> Float64:
    """float64 (N, 3), outline of the pattern or its paper, in steps of a quarter square."""
    outlines = dark_polygons(board)
    (x0, y0), (x1, y1) = outlines.min(axis=(0, 1)), outlines.max(axis=(0, 1))
    more = margin * board.square_m
    columns, rows = board.squares
    x = np.linspace(x0 - more, x1 + more, 4 * columns + 1)
    y = np.linspace(y0 - more, y1 + more, 4 * rows + 1)
    level = [np.stack([x, np.full_like(x, end)], axis=1) for end in (y[0], y[-1])]
    upright = [np.stack([np.full_like(y, end), y], axis=1) for end in (x[0], x[-1])]
    flat = np.concatenate([*level, *upright])
    return np.hstack([flat, np.zeros((len(flat), 1))])
