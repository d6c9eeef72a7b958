"""A drive that has ended is made level by all its frames, where its first one was mistaken."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from recon.core.geometry.se3 import rotate
from recon.core.values.arrays import Bool, Float64
from recon.core.work import side_by_side
from recon.map.ground.axes import estimate_ground, map_axes
from recon.map.ground.level import Level, level_by_surfaces
from recon.map.sessions.placed import CastSubmaps
from recon.map.settings import DriveSettings
from recon.map.store.session import Session
from recon.odometry.imu import ImuGuide, ImuSpan, up_of_drive

_SIGMAS: Final = 3.0  # that axes are off before they are turned
_MOST_SUBMAPS: Final = 40  # whose surfaces are looked at, all along the drive


def level_drive(
    session: Session,
    settings: DriveSettings,
    placed: Bool,
    guide: ImuGuide | None = None,
    threads: int = 1,
) -> None:
    """Find what is up by the frames of a drive that have a place in its map, ``placed`` (N,).

    Where its axes are off by more than is known so well, they are turned, and occupancy is made
    again of its rays. What is set or a robot says stays, but for what an inertial unit says.
    """
    before = session.level
    done = before is None or before.by == "setting" or math.isfinite(before.sigma_deg)
    if before is None or done or not placed.any():
        return
    up, level = None, before
    if guide is not None:
        up, level = _by_imu(session, placed, guide) or (up, level)
    if up is None and before.by not in ("imu", "robot"):
        path = session.trajectory.T_world_camera[placed]
        up, level = level_by_surfaces(_normals(session, settings, placed), path)
    if up is None:  # that too little was seen does not make the first frame wrong
        session.level = level if level.contradicted else before
        session.set_axes(session.T_map_world, session.camera)
        return
    off_deg = math.degrees(math.acos(np.clip(session.T_map_world[2, :3] @ up, -1.0, 1.0)))
    turned = off_deg > _SIGMAS * level.sigma_deg and session.ray_frames == len(session)
    session.level = level if turned else replace(level, sigma_deg=max(level.sigma_deg, off_deg))
    T_map_world = _axes(session, settings, up) if turned else session.T_map_world
    session.set_axes(T_map_world, session.camera)
    if turned:
        cast = CastSubmaps(session, settings)
        for submap in side_by_side(cast.__getitem__, range(len(cast)), threads=threads):
            session.submaps.add(submap)


def _axes(session: Session, settings: DriveSettings, up: Float64) -> Float64:
    """Return T_map_world (4, 4) for what is up (3,), world axes, by the first surfaces seen."""
    fused, mount = session.submaps[0].fused, session.mount
    cloud = replace(fused.cloud(settings.fusion.voxel_m, 1), frame="camera")
    ground = estimate_ground(cloud, settings.scale, up)
    mounted_m = None if mount is None else mount.camera_height_m
    height_m = settings.ground.camera_height_m or mounted_m
    if ground is None and height_m is None:
        height_m = float(session.T_map_world[2, 3])
    turn = None if mount is None else mount.T_base_camera[:3, :3]
    return map_axes(ground, settings.axes, height_m, up, turn)


def _by_imu(session: Session, placed: Bool, guide: ImuGuide) -> tuple[Float64, Level] | None:
    """Return what is up by an inertial unit; None = it does not know."""
    health = [one for one, there in zip(session.health, placed, strict=True) if there]
    sigmas = np.array([(one.sigma_m, math.radians(one.sigma_deg)) for one in health[1:]])
    run = ImuSpan(session.trajectory.select(placed), *sigmas.reshape(-1, 2).T)
    found = up_of_drive(guide, run)
    return None if found is None else (found[0], Level("imu", found[1]))


def _normals(session: Session, settings: DriveSettings, placed: Bool) -> Float64:
    """Return normals (N, 3) of surfaces all along a drive, world axes, in the order of frames."""
    entries, moves = session.submaps.entries, session.corrections()
    there = [n for n, one in enumerate(entries) if placed[one.middle]]
    chosen, found = there[:: math.ceil(len(there) / _MOST_SUBMAPS) or 1], [np.zeros((0, 3))]
    for n in chosen:
        normals = session.submaps[n].fused.cloud(settings.fusion.voxel_m, 2).normals
        if normals is not None:
            known = normals[np.isfinite(normals).all(axis=1)].astype(np.float64)
            found.append(known if moves is None else rotate(moves[n], known))
    return np.concatenate(found)
