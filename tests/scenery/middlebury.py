"""Small scenes in the layout of MiddEval3."""

from pathlib import Path

import cv2
import numpy as np

from recon.core.values import DisparityTruth, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import UInt8
from recon.io.images.disparity import write_pfm
from recon.io.images.image import write_image
from tests.scenery.planes import PlanePair, slanted_pair

CALIB = """cam0=[{f} 0 {cx}; 0 {f} {cy}; 0 0 1]
cam1=[{f} 0 {cx1}; 0 {f} {cy}; 0 0 1]
doffs={doffs}
baseline={baseline_mm}
width={width}
height={height}
ndisp={ndisp}
isint=0
"""
CAMERA = RectifiedCamera(180.0, 55.0, 40.0, 65.0, 0.2, 120, 80, 24)
"""With a doffs of 10, disparities of 5 to 20 px lie at 180 · 0.2 / (d + 10) = 2.4 to 1.2 m."""
HEIGHT, WIDTH, NEAR, FAR = 48, 96, 12, 4


def write_scene(folder: Path, scene: PlanePair | None = None, *, truth: bool = True) -> None:
    """Write a scene, by default a slanted wall."""
    folder.mkdir(parents=True)
    scene = scene or slanted_pair(CAMERA, 1.5, (0.1, -0.1), seed=1)
    camera = scene.pair.camera
    for name, grey in (("im0.png", scene.pair.left), ("im1.png", scene.pair.right)):
        write_image(folder / name, np.repeat(grey[:, :, None], 3, axis=2))
    if truth:
        write_pfm(folder / "disp0GT.pfm", scene.truth.values)
    write_image(folder / "mask0nocc.png", np.where(scene.truth.nonocc, 255, 128).astype(np.uint8))
    values = {"f": camera.focal_px, "cx": camera.cx_px, "cy": camera.cy_px, "ndisp": camera.ndisp}
    values |= {"cx1": camera.cx_right_px, "doffs": camera.doffs_px, "width": camera.width_px}
    values |= {"baseline_mm": 1000 * camera.baseline_m, "height": camera.height_px}
    (folder / "calib.txt").write_text(CALIB.format(**values))


def square(scale: int = 1) -> PlanePair:
    """A square in front of a wall, all at whole pixels, at 1 or 2 times the smallest size."""
    height, width, near, far = (scale * size for size in (HEIGHT, WIDTH, NEAR, FAR))
    wall, texture = noise(1, (height, 2 * width)), noise(2, (height, width))
    rows, x0, x1 = slice(12 * scale, 36 * scale), 40 * scale, 70 * scale
    left, right = wall[:, :width].copy(), wall[:, far : far + width].copy()
    left[rows, x0:x1] = right[rows, x0 - near : x1 - near] = texture[rows, x0:x1]
    disparity = np.full((height, width), far, np.float32)
    disparity[rows, x0:x1] = near
    nonocc = np.ones((height, width), bool)
    nonocc[rows, x0 - near + far : x0] = nonocc[:, :far] = False
    f, cx = 100 * scale, 40 * scale
    camera = RectifiedCamera(f, cx, 20, cx + scale, 0.1, width, height, 16 * scale)
    return PlanePair(RectifiedPair(left, right, camera), DisparityTruth(disparity, nonocc))


def noise(seed: int, shape: tuple[int, int]) -> UInt8:
    image = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(image, (3, 3), 0), np.uint8)
