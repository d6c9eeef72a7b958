"""How a drive's surface looks from where an image was taken that its texture does not have.

The drive is mapped, and every tenth image left out of the texture. From where those were taken, the
surface is drawn with its texture, and with the colours of its vertices (of which the fused points
know all images). Pixels that the surface covers are compared, on grey levels; ``covered`` is their
share. Each drawing is first made as bright as the image. ``within`` is the same of pixels that are
20 pixels or more away from where one surface ends before another: neither drawing can be better
than the outlines of the surface. SSIM: Z. Wang et al., IEEE Transactions on Image Processing 13(4),
2004.

Examples:
    python benchmarks/textures.py DRIVE --json
    python benchmarks/textures.py --street --pictures folder
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np

from recon.commands.config import load_config
from recon.commands.demo import demo_source
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.geometry.se3 import rotate
from recon.core.open3d_raycasting import RayScene
from recon.core.values import RectifiedCamera, TriangleMesh
from recon.core.values.arrays import Float64, UInt8
from recon.core.values.camera import unproject
from recon.export.mesh.pieces import WHOLE
from recon.export.mesh.texture import textured_mesh
from recon.export.mesh.views import PosedImage, posed_images
from recon.export.product import open_images
from recon.io.images.image import write_image
from recon.io.models.mesh import read_mesh
from recon.map.fusion import fusion_range_m
from recon.map.map import Map
from recon.sources.registry import open_source

LEFT_OUT: Final = 10
SIDE_PX: Final = 8192
WITHIN_PX: Final = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", type=Path, nargs="?")
    parser.add_argument("--street", action="store_true", help="the rendered street of the demo")
    parser.add_argument("--pictures", type=Path, help="folder for what is compared")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    config = load_config(None)
    source = demo_source(config) if given.street else open_source(given.drive)
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        run_map(source, config, MapOptions(out=run, audit=False))
        found = measure(run, given.pictures, [] if given.street else [given.drive])
    print(
        json.dumps(found) if given.json else "\n".join(f"{k:12} {v:.3g}" for k, v in found.items())
    )


def measure(run: Path, pictures: Path | None, images: Sequence[Path] = ()) -> dict[str, float]:
    """Texture the map of a run, and compare it with the images that were left out."""
    mesh = read_mesh(run / WHOLE)
    with closing(Map.open(run)) as map_:
        drives, session = open_images(map_, images), map_.first
        range_m = fusion_range_m(session.camera, load_config(run / "config.yaml").fusion)
        voxel_m = load_config(run / "config.yaml").fusion.voxel_m

        def shown() -> Iterable[PosedImage]:
            return (view for view in posed_images(drives) if view.number % LEFT_OUT)

        textured, _ = textured_mesh(mesh, shown, voxel_m, range_m, SIDE_PX)
        scene = RayScene(mesh.vertices[mesh.faces])
        left_out = (view for view in posed_images(drives) if view.number % LEFT_OUT == 0)
        rows = [compare(view, mesh, textured, scene, pictures) for view in left_out]
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def compare(
    view: PosedImage, mesh: TriangleMesh, textured: TriangleMesh, scene: RayScene, to: Path | None
) -> dict[str, float]:
    """Compare what an image shows with both surfaces, from the same place."""
    row, column = (axis.ravel() for axis in np.indices(view.image.shape[:2]))
    rays = rotate(view.T_map_camera, unproject(column, row, np.ones(len(row)), view.camera))
    eye = view.T_map_camera[:3, 3]
    face = scene.first_hit(eye, rays)
    hit = face >= 0
    ratios, depth = ratios_at(mesh, face[hit], eye, rays[hit])
    texture = textured.texture
    if texture is None or mesh.rgb is None:
        raise LookupError("a surface has no colours")
    uv = np.einsum("nc,ncd->nd", ratios, texture.uv[textured.faces[face[hit]]])
    colours = {
        "vertices": np.einsum("nc,ncd->nd", ratios, mesh.rgb[mesh.faces[face[hit]]]),
        "texture": looked_up(texture.image, uv),
    }
    mask, found = hit.reshape(view.image.shape[:2]), {"covered": float(hit.mean())}
    within = mask & (from_steps(mask, depth, view.camera) >= WITHIN_PX)
    true = cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    if to is not None:
        write_image(to / f"{view.number:06d}_image.png", view.image)
    for name, rgb in colours.items():
        picture = view.image.copy()
        # How the image was exposed, nothing knows.
        gain = view.image[mask].mean() / rgb.mean()
        picture[mask] = np.clip(np.rint(gain * rgb), 0, 255).astype(np.uint8)
        drawn = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float64)
        for where, part in ((f"PSNR, {name}", mask), (f"within, {name}", within)):
            found[where] = 20 * np.log10(255 / np.sqrt(((drawn - true)[part] ** 2).mean()))
        found[f"SSIM, {name}"] = float(ssim(drawn, true)[mask].mean())
        if to is not None:
            write_image(to / f"{view.number:06d}_{name}.png", picture)
    return found


def from_steps(mask: Any, depth: Float64, camera: RectifiedCamera) -> Any:
    """How far each pixel is from where the disparity of the surface steps by more than one."""
    disparity = np.zeros(mask.shape)
    disparity[mask] = camera.focal_px * camera.baseline_m / depth
    around = np.ones((3, 3), np.uint8)
    smooth = (cv2.dilate(disparity, around) - cv2.erode(disparity, around)) <= 1.0
    return cv2.distanceTransform(smooth.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)


def ratios_at(
    mesh: TriangleMesh, face: Any, eye: Float64, rays: Float64
) -> tuple[Float64, Float64]:
    """How much each corner of its face counts where a ray meets it: (N, 3); and its depth."""
    a, b, c = mesh.vertices[mesh.faces[face]].astype(np.float64).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    depth = np.einsum("ij,ij->i", normal, a - eye) / np.einsum("ij,ij->i", normal, rays)
    at = eye + depth[:, None] * rays
    size = np.einsum("ij,ij->i", normal, normal)
    second = np.einsum("ij,ij->i", np.cross(at - a, c - a), normal) / size
    third = np.einsum("ij,ij->i", np.cross(b - a, at - a), normal) / size
    ratios = np.clip(np.stack([1 - second - third, second, third], axis=1), 0, 1)
    return np.asarray(ratios), np.asarray(depth)


def looked_up(image: UInt8, uv: Float64) -> Any:
    """The colours of a picture at places from 0 to 1: (N, 3)."""
    at = (uv * image.shape[1::-1] - 0.5).astype(np.float32)
    parts = [at[None, first : first + 30_000] for first in range(0, len(at), 30_000)]
    found = [cv2.remap(image, part, None, cv2.INTER_LINEAR).reshape(-1, 3) for part in parts]
    return np.concatenate(found)


def ssim(one: Float64, other: Float64) -> Float64:
    """Structural similarity around each pixel (H, W)."""

    def mean(image: Float64) -> Any:
        return cv2.GaussianBlur(image, (11, 11), 1.5)

    a, b, c1, c2 = mean(one), mean(other), (0.01 * 255) ** 2, (0.03 * 255) ** 2
    aa, bb, ab = mean(one * one) - a * a, mean(other * other) - b * b, mean(one * other) - a * b
    return np.asarray((2 * a * b + c1) * (2 * ab + c2) / ((a * a + b * b + c1) * (aa + bb + c2)))


if __name__ == "__main__":
    main()
