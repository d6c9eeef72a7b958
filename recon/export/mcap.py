"""A map and its drives as a bag of ROS 2: what Foxglove shows, and RViz plays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import ReconError
from recon.core.geometry.se3 import invert, make_transform
from recon.core.values.arrays import Float64, UInt8
from recon.export.cloud import even_sample
from recon.export.occupancy import Flattening
from recon.export.product import DriveImages, ExportContext, ExportResult, ProductFigures
from recon.io.atomic import write_text
from recon.io.images.image import encode_image
from recon.io.ros.bag import RosBag, write_bag
from recon.io.ros.messages import grid_message, header, points, pose, stamp_of, transforms
from recon.map.ground.axes import base_axes
from recon.map.store.session import Session
from recon.places.closure import USUAL, DrivePath
from recon.places.places import spread_over

_LAYOUT: Final = Path(__file__).with_name("foxglove.json")


@dataclass(frozen=True)
class BagFigures(ProductFigures):
    """A bag."""

    bag_frames: int


def mcap_product(context: ExportContext, folder: Path) -> ExportResult:
    """Write a folder with a bag: transforms, odometry, what each frame saw, cloud, grid, images.

    Images are there if they can be read again. Beside it is a layout for Foxglove. Coordinates of
    a survey are a frame, ``survey``, in which that of the map lies.
    """
    warnings = []
    grid, height_m, _ = Flattening(context.placed).grid()
    images: dict[int, DriveImages] = {}
    try:
        images = {one.session.number: one for one in context.drives}
    except ReconError as error:
        if context.images:
            raise
        warnings.append(f"no images in the bag: {error}")
    drives = [_Drive(context, session, height_m) for session in context.map.linked]
    fixed = [] if context.survey is None else [("survey", "map", context.T_survey_map)]
    fixed += [edge for drive in drives for edge in drive.mounted()]
    start_ns, frames = min(drive.times_ns[0] for drive in drives), 0
    with write_bag(folder) as bag:
        bag.write("/tf_static", start_ns, transforms(start_ns, fixed), kept=True)
        bag.write("/map/grid", start_ns, grid_message(start_ns, grid), kept=True)
        cloud = points(header("map", start_ns), even_sample(context.placed.tiles))
        bag.write("/map/cloud", start_ns, cloud, kept=True)
        for drive in drives:
            for frame, views in drive.frames(images.get(drive.session.number)):
                drive.write(bag, frame, views)
                frames += 1
    write_layout(folder, drives[0].name, drives[0].base)
    return ExportResult(BagFigures(frames), warnings)


def write_layout(
    folder: Path, name: str = "", base: str = "base_link", *, live: bool = False
) -> None:
    """Write a layout of Foxglove beside a bag, for topics and frames that begin with a name.

    Those of ``live`` topics have the map under other names.
    """
    layout = _LAYOUT.read_text(encoding="utf-8").replace("DRIVE/base_link", base)
    layout = layout.replace("DRIVE/", name)
    if live:
        layout = layout.replace("/map/grid", f"/{name}map").replace("/map/cloud", f"/{name}cloud")
    write_text(folder / "foxglove.json", layout)


class _Drive:
    """What is written of a drive, by frame."""

    def __init__(self, context: ExportContext, session: Session, height_m: float | None) -> None:
        self.session, self.placed = session, context.map.placed[session.number]
        # Of its topics and frames, with a slash.
        self.name = f"drive{session.number}/" if len(context.map.linked) > 1 else ""
        self.base = f"{self.name}{'base_link' if session.mount is None else session.mount.base}"
        T_map_world = context.map.first.T_map_world
        self._T_base_camera = base_axes(T_map_world, height_m, session.mount)
        path = session.trajectory
        self.times_ns = [stamp_of(time_s, session.where) for time_s in path.timestamps_s.tolist()]
        T_camera_base = invert(self._T_base_camera)
        self._T_map_base = session.T_map_world @ path.T_world_camera @ T_camera_base
        self._variance = _variance(session)

    def mounted(self) -> list[tuple[str, str, Float64]]:
        """Return where the cameras are on the vehicle."""
        beside = make_transform(np.eye(3), np.array([self.session.camera.baseline_m, 0.0, 0.0]))
        left, right = (f"{self.name}{one}" for one in ("left", "right"))
        return [(self.base, left, self._T_base_camera), (left, right, beside)]

    def frames(self, images: DriveImages | None) -> Iterator[tuple[int, tuple[UInt8, ...]]]:
        """Yield the frames that have a place, with rectified images if they can be read."""
        if images is None:
            yield from ((frame, ()) for frame in np.flatnonzero(self.placed).tolist())
        else:
            yield from images.views()

    def write(self, bag: RosBag, frame: int, views: tuple[UInt8, ...]) -> None:
        time_ns, T, base = self.times_ns[frame], self._T_map_base[frame], self.base
        bag.write("/tf", time_ns, transforms(time_ns, [("map", base, T)]))
        spread = np.diag(np.repeat(self._variance[frame], 3)).ravel()
        content = {
            "header": header("map", time_ns), "child_frame_id": base,
            "pose": {"pose": pose(T), "covariance": spread}, "twist": {"covariance": 0 * spread},
        }  # fmt: skip
        bag.write(f"/{self.name}odometry", time_ns, ("nav_msgs/msg/Odometry", content))
        if self.session.ray_frames == len(self.placed):
            seen = points(header(f"{self.name}left", time_ns), self.session.rays(frame)[0].cloud())
            bag.write(f"/{self.name}points", time_ns, seen)
        camera = self.session.camera
        shift = -camera.focal_px * camera.baseline_m * np.eye(3)[:, :1]
        lenses = ("left", camera.matrix, 0 * shift), ("right", camera.right_matrix, shift)
        for image, (side, matrix, last) in zip(views, lenses, strict=False):
            name = f"{self.name}{side}"
            head, jpeg = header(name, time_ns), encode_image(image, ".jpg", name)
            content = {"header": head, "format": "jpeg", "data": np.frombuffer(jpeg, np.uint8)}
            message = "sensor_msgs/msg/CompressedImage", content
            bag.write(f"/{name}/image/compressed", time_ns, message)
            info = {
                "header": head, "width": camera.width_px, "height": camera.height_px,
                "distortion_model": "plumb_bob", "d": np.zeros(5), "k": matrix.ravel(),
                "r": np.eye(3).ravel(), "p": np.hstack([matrix, last]).ravel(),
            }  # fmt: skip
            bag.write(f"/{name}/camera_info", time_ns, ("sensor_msgs/msg/CameraInfo", info))


def _variance(session: Session) -> Float64:
    """Return (N, 2), variances of positions and rotations since the beginning of each segment."""
    path = DrivePath.of(session.odometry, session.health, session.scale)
    begins = np.searchsorted(np.maximum.accumulate(path.segment), path.segment)
    drift = np.stack(spread_over(path.path_m - path.path_m[begins], path.scale), axis=1)
    return np.asarray((USUAL * drift) ** 2 + path.variance - path.variance[begins])
