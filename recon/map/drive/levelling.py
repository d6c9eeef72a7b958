"""A drive that has ended is made level by all its frames, where its first one was mistaken."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from recon.core.geometry.se3 import rotate
from recon.core.values.arrays import Bool, Float64
from recon.core.work import side_by_side
from recon.map.ground.axes import UP_MAP, short_turn
from recon.map.ground.level import LEVEL_DEG, TOO_FEW, Level, level_by_surfaces
from recon.map.sessions.placed import CastSubmaps
from recon.map.settings import DriveSettings
from recon.map.store.session import Session
from recon.odometry.imu import ImuGuide, up_of_drive

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

    Where its axes are off by more than is known so well, of surfaces by more than what still counts
    as level, they are turned, and occupancy is made again of its rays. What is set or a robot says
    stays, but for what an inertial unit says.
    """
    before = session.level
    if before.by == "setting" or math.isfinite(before.sigma_deg) or not placed.any():
        return
    up, level = None, before
    path = session.trajectory.select(placed)
    if guide is not None:
        steps_m = [one.sigma_m for one, there in zip(session.health, placed, strict=True) if there]
        up, sigma_deg = up_of_drive(guide, path, np.array(steps_m[1:]))
        level = before if up is None else Level("imu", sigma_deg)
    if up is None and before.by not in ("imu", "robot"):
        normals = _normals(session, settings, placed)
        up, level = level_by_surfaces(normals, path.T_world_camera)
    T_map_world, turned = session.T_map_world, False
    if up is not None:
        off_deg = math.degrees(math.acos(np.clip(T_map_world[2, :3] @ up, -1.0, 1.0)))
        # What depth errs in leans normals of a floor, alike in all frames, by some degrees.
        least_deg = LEVEL_DEG if level.by == "surfaces" else 0.0
        certain = off_deg > max(_SIGMAS * level.sigma_deg, least_deg)
        turned = certain and session.ray_frames == len(session)
        level = level if turned else replace(level, sigma_deg=max(level.sigma_deg, off_deg))
        if turned:  # the short way; what the origin is above stays so far below
            R_map_world = T_map_world[:3, :3]
            T_map_world[:3, :3] = short_turn(R_map_world @ up, UP_MAP) @ R_map_world
    # That too little was seen does not make the first frame wrong.
    session.level = before if level.why == TOO_FEW else level
    session.set_axes(T_map_world, session.camera)
    if turned:
        cast = CastSubmaps(session, settings)
        for submap in side_by_side(cast.__getitem__, range(len(cast)), threads=threads):
            session.submaps.add(submap)


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
