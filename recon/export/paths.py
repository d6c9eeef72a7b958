"""The path of a drive as files: in world axes, in map axes, and before loops were closed."""

from __future__ import annotations

from dataclasses import replace

from recon.core.geometry.se3 import invert
from recon.io.trajectory import write_kitti_poses, write_tum
from recon.map.drive.sequence import MappedSequence
from recon.map.ground.axes import base_axes
from recon.run.directory import RunDirectory


def export_paths(
    mapped: MappedSequence, camera_height_m: float | None, directory: RunDirectory
) -> None:
    """Write ``trajectory_*.txt``, and ``loops.json`` if loops were closed.

    Args:
        mapped: The mapped drive.
        camera_height_m: Height of the camera above the ground; None = unknown.
        directory: The folder of the run.

    Raises:
        OutputError: A file cannot be written.
    """
    path, T_map_world = mapped.trajectory, mapped.T_map_world
    write_kitti_poses(directory.path("trajectory_kitti.txt"), path)
    write_tum(directory.path("trajectory_tum.txt"), path)
    T_map_base = T_map_world @ path.T_world_camera @ invert(base_axes(T_map_world, camera_height_m))
    based = replace(path, T_world_camera=T_map_base)
    write_tum(directory.path("trajectory_map_base_tum.txt"), based)
    if mapped.loops is not None and mapped.loops.closure.closed:
        write_tum(directory.path("trajectory_odometry_tum.txt"), mapped.loops.odometry)
        directory.write_json("loops.json", mapped.loops.edges())
