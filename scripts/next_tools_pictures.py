"""Draw the pictures of docs/next-tools.md: what other programs make of a rendered drive.

    python scripts/next_tools_pictures.py [NAME…]

MeshLab, CloudCompare, Blender and QGIS draw for themselves, in a display without a screen (Debian:
`apt install meshlab cloudcompare blender qgis python3-qgis xvfb xdotool imagemagick`); what has no
program here is drawn from what its library reads. A program that is missing leaves its picture as
it is, and says so.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from recon.commands.config import load_config
from recon.commands.demo import demo_source
from recon.commands.export import run_export
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.io.images.image import read_image, read_levels
from recon.io.trajectory import read_tum
from recon.map.sessions.measured import Survey

IMAGES: Final = Path(__file__).resolve().parents[1] / "docs" / "images" / "next"
WIDTH_PX: Final = 800
PATIENCE_S: Final = 25  # until a window has drawn what it was given
BLENDER: Final = """
import numpy as np, sys
np.bool = bool  # which older importers still use
import bpy
from mathutils import Vector
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=sys.argv[-2])
corners = [o.matrix_world @ Vector(c) for o in bpy.context.scene.objects if o.type == "MESH"
           for c in o.bound_box]
low, high = (Vector(map(of, zip(*corners))) for of in (min, max))
middle, scene = (low + high) / 2, bpy.context.scene
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
camera.data.lens = 24
camera.location = Vector((middle.x, low.y - 2, low.z + 9))
camera.rotation_euler = (Vector((middle.x, low.y + 16, low.z)) - camera.location
                         ).to_track_quat("-Z", "Y").to_euler()
bpy.context.collection.objects.link(camera)
scene.camera, scene.world = camera, bpy.data.worlds.new("world")
scene.world.use_nodes = True
scene.world.node_tree.nodes["Background"].inputs[0].default_value = (1, 1, 1, 1)
scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 16, False
scene.view_settings.view_transform = "Standard"
scene.render.resolution_x, scene.render.resolution_y = 960, 540
scene.render.filepath = sys.argv[-1]
bpy.ops.render.render(write_still=True)
"""
QGIS: Final = """
import os, sys
os.environ["QT_QPA_PLATFORM"] = "offscreen"
from qgis.core import QgsApplication, QgsMapRendererParallelJob, QgsMapSettings, QgsRasterLayer
from qgis.PyQt.QtCore import QSize
QgsApplication.setPrefixPath("/usr", True)
program = QgsApplication([], False)
program.initQgis()
layer = QgsRasterLayer(sys.argv[1], "orthophoto")
assert layer.isValid() and layer.crs().authid() == "EPSG:25832"
view = QgsMapSettings()
view.setLayers([layer])
view.setOutputSize(QSize(800, 600))
view.setDestinationCrs(layer.crs())
view.setExtent(layer.extent())
job = QgsMapRendererParallelJob(view)
job.start()
job.waitForFinished()
job.renderedImage().save(sys.argv[2])
"""


def main(names: Sequence[str]) -> None:
    IMAGES.mkdir(parents=True, exist_ok=True)
    chosen = names or [*PICTURES]
    with tempfile.TemporaryDirectory() as folder:
        needed = {product for name in chosen for product in PICTURES[name][1]}
        out = exported(Path(folder), sorted(needed))
        for name in chosen:
            draw, _ = PICTURES[name]
            picture = Path(folder) / f"{name}.png"
            try:
                draw(out, picture)
            except FileNotFoundError as error:
                print(f"{name}: no picture, {error.filename or error} is not installed")
            else:
                keep(picture, IMAGES / f"{name}.jpg")


def exported(folder: Path, products: Sequence[str]) -> Path:
    """Map the rendered drive, and make products of it."""
    config, run, out = load_config(None), folder / "run", folder / "out"
    run_map(demo_source(config), config, MapOptions("demo", run, audit=False))
    path = read_tum(run / "trajectory_map_base_tum.txt")
    there = path.positions_m + np.array([455_800.0, 5_429_300.0, 115.0])
    np.savetxt(folder / "gnss.txt", np.column_stack([path.timestamps_s, there]), fmt="%.4f")
    survey = Survey(folder / "gnss.txt", crs="EPSG:25832") if "orthophoto" in products else None
    run_export(run, products=products, formats=("glb",), out=out, survey=survey)
    return out


def keep(picture: Path, to: Path) -> None:
    image = read_image(picture)
    # Without a window manager, a window may be smaller than the screen behind it.
    rows, columns = (np.flatnonzero(image.any(axis=(axis, 2))) for axis in (1, 0))
    image = image[: rows[-1] + 1, : columns[-1] + 1]
    height = round(image.shape[0] * WIDTH_PX / image.shape[1])
    small = cv2.resize(image, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(to), small[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])
    print(f"{to.name}: {to.stat().st_size // 1000} kB")


def window(program: str, file: Path, picture: Path, keys: str = "") -> None:
    """Photograph the window of a program that has opened a file."""
    if shutil.which(program) is None or shutil.which("xvfb-run") is None:
        raise FileNotFoundError(program)
    script = f"{program} {file} & sleep {PATIENCE_S}; {keys} import -window root {picture}; kill %1"
    screen = ["xvfb-run", "-a", "-s", "-screen 0 1280x800x24 +extension GLX"]
    environment = {**os.environ, "LIBGL_ALWAYS_SOFTWARE": "1"}
    subprocess.run(
        [*screen, "bash", "-c", script],
        check=False,
        env=environment,
        capture_output=True,
        timeout=180,
    )


def meshlab(out: Path, picture: Path) -> None:
    window("meshlab", out / "texture/mesh.mlp", picture)


def cloudcompare(out: Path, picture: Path) -> None:
    # It asks what the fields of a PLY are.
    window("CloudCompare", out / "map/cloud.ply", picture, "xdotool key Return; sleep 5;")


def blender(out: Path, picture: Path) -> None:
    script = picture.with_suffix(".py")
    script.write_text(BLENDER)
    words = ["blender", "-b", "--python", str(script), "--", str(out / "texture/mesh.glb")]
    subprocess.run([*words, str(picture)], check=True, capture_output=True)


def qgis(out: Path, picture: Path) -> None:
    script = picture.with_name("draw.py")
    script.write_text(QGIS)
    if not Path("/usr/lib/python3/dist-packages/qgis").is_dir():
        raise FileNotFoundError("python3-qgis")
    words = ["/usr/bin/python3", str(script), str(out / "map/orthophoto.tif"), str(picture)]
    done = subprocess.run(words, check=False, capture_output=True, text=True)
    if done.returncode:
        raise ChildProcessError(done.stderr)


def nav2(out: Path, picture: Path) -> None:
    """Grid above, costmap below, as map_server reads them: grey as it is, transparent as blue."""
    grid = cv2.cvtColor(read_image(out / "map/grid.pgm"), cv2.COLOR_RGB2BGR)
    costs = cv2.imread(str(out / "map/costmap.png"), cv2.IMREAD_UNCHANGED)
    shown = np.where(costs[:, :, 3:] > 0, costs[:, :, :3], (200, 170, 140))
    both = np.vstack([grid, np.full((4, grid.shape[1], 3), 255), shown]).astype(np.uint8)
    size = (4 * both.shape[1], 4 * both.shape[0])
    cv2.imwrite(str(picture), cv2.resize(both, size, interpolation=cv2.INTER_NEAREST))


def colmap(out: Path, picture: Path) -> None:
    """An image with the points that the model says it sees: found in green, projected in red."""
    import pycolmap  # noqa: PLC0415

    model = pycolmap.Reconstruction(str(out / "colmap/sparse/0"))
    image = max(model.images.values(), key=lambda one: one.num_points3D)
    shown = cv2.imread(str(out / "colmap/images" / image.name))
    shown = cv2.resize(shown, None, fx=2, fy=2)
    for point in image.points2D:
        if point.has_point3D():
            ours = image.project_point(model.points3D[point.point3D_id].xyz)
            for place, colour, radius in ((point.xy, (0, 200, 0), 5), (ours, (0, 0, 255), 2)):
                centre = tuple(round(2 * float(x)) for x in place)
                cv2.circle(shown, centre, radius, colour, 1, cv2.LINE_AA)
    cv2.imwrite(str(picture), shown)


def nerfstudio(out: Path, picture: Path) -> None:
    """Image, and depth in millimetres, as ``transforms.json`` names them."""
    told = json.loads((out / "nerfstudio/transforms.json").read_text())
    frame = told["frames"][0]
    image = read_image(out / "nerfstudio" / frame["file_path"])[:, :, ::-1]
    depth = read_levels(out / "nerfstudio" / frame["depth_file_path"]).astype(np.float64)
    near = np.divide(3000.0, depth, out=np.zeros_like(depth), where=depth > 0)
    colours = cv2.applyColorMap(np.clip(255 * near, 0, 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    colours[depth == 0] = 0
    cv2.imwrite(str(picture), np.vstack([image, colours]))


def foxglove(out: Path, picture: Path) -> None:
    """Grid, cloud and path of the bag from above, as its 3-D panel shows them."""
    import matplotlib as mpl  # noqa: PLC0415
    from rosbags.highlevel import AnyReader  # noqa: PLC0415

    mpl.use("Agg")
    import matplotlib.pyplot as plt  # noqa: PLC0415

    figure, axes = plt.subplots(figsize=(10, 5))
    places = []
    with AnyReader([out / "bag"]) as bag:
        for connection, _, raw in bag.messages():
            if connection.topic not in ("/map/grid", "/map/cloud", "/odometry"):
                continue
            message = bag.deserialize(raw, connection.msgtype)
            if connection.topic == "/odometry":
                places.append((message.pose.pose.position.x, message.pose.pose.position.y))
            elif connection.topic == "/map/grid":
                info, origin = message.info, message.info.origin.position
                cells = np.ma.masked_less(message.data.reshape(info.height, info.width), 0)
                ends = (
                    origin.x + info.width * info.resolution,
                    origin.y + info.height * info.resolution,
                )
                axes.imshow(cells, cmap="Greys", origin="lower", alpha=0.4,
                            extent=(origin.x, ends[0], origin.y, ends[1]))  # fmt: skip
            else:
                rows = message.data.view(np.float32).reshape(message.width, -1)
                rgb = rows[:, 3].copy().view(np.uint32)[:, None] >> np.array([16, 8, 0]) & 255
                axes.scatter(rows[:, 0], rows[:, 1], s=0.5, c=rgb / 255.0, linewidths=0)
    axes.plot(*np.array(places).T, color="tab:orange", linewidth=2)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figure.savefig(picture, dpi=100, bbox_inches="tight")


PICTURES: Final[dict[str, tuple[Callable[[Path, Path], None], tuple[str, ...]]]] = {
    "nav2": (nav2, ("grid", "costmap")),
    "foxglove": (foxglove, ("mcap",)),
    "meshlab": (meshlab, ("texture",)),
    "cloudcompare": (cloudcompare, ("cloud",)),
    "blender": (blender, ("texture",)),
    "qgis": (qgis, ("orthophoto",)),
    "colmap": (colmap, ("colmap",)),
    "nerfstudio": (nerfstudio, ("nerfstudio",)),
}
"""What draws a picture, and of which products."""

if __name__ == "__main__":
    main(sys.argv[1:])
