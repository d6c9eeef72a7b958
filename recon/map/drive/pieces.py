"""A long drive in pieces that overlap: where it is cut, and how the pieces become one drive again.

Each piece is mapped alone. Its first frames, the lead, are also the last ones of the piece before:
there the odometry gets going, and a frame that both pieces have joins them. This joint is exact, as
it is one frame; the motion before and after it is as uncertain as in a drive that was never cut.
Loops are then looked for in the whole drive.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np

from recon.core.geometry.se3 import invert, orthonormalise
from recon.core.values.arrays import Float64
from recon.map.drive.drive_loops import DriveLoops, LoopWatch
from recon.map.drive.sequence import MappedSequence
from recon.map.drive.workspace import Workspace
from recon.map.settings import DriveSettings
from recon.map.store.record_values import RAYS
from recon.map.store.records import Key
from recon.map.store.session import Session
from recon.map.submaps import Submap
from recon.map.verbs import Map
from recon.places.detector import LoopDetector, StoredKeyframe
from recon.places.places import path_lengths
from recon.sources.source import SourcePart, StereoSource
from recon.stereo.frame import FrameReconstructor

LEAD: Final = 20
"""Frames that a piece has in common with the one before."""
_LEAST: Final = 2 * LEAD
"""Frames of the shortest piece, without its lead."""
_MOST: Final = 1000
"""Frames of the longest piece: what is lost with a worker, and the time that others wait for it."""


@dataclass(frozen=True)
class Piece:
    """A piece of a drive.

    Attributes:
        first: Its first frame.
        last: The frame behind its last one.
        lead: How many of its frames belong to the piece before.
    """

    first: int
    last: int
    lead: int = 0

    def of(self, source: StereoSource) -> SourcePart:
        """Return the frames of the piece."""
        return SourcePart(source, self.first, self.last, self.lead)


def cut_drive(frames: int, workers: int) -> list[Piece]:
    """Cut a drive into pieces of about the same length, several for each worker if it is long.

    A drive that is too short for so many pieces gets fewer.
    """
    rounds = math.ceil(frames / (workers * _MOST))
    count = max(1, min(workers * rounds, frames // _LEAST))
    ends = [round(frames * number / count) for number in range(count + 1)]
    return [
        Piece(begin - LEAD if begin else 0, end, LEAD if begin else 0)
        for begin, end in pairwise(ends)
    ]


def join_pieces(
    map_: Map, pieces: Sequence[Piece], mapped: Iterable[Map], settings: DriveSettings
) -> None:
    """Put the maps of the pieces of a drive into one drive, and look for loops in it.

    Args:
        map_: The map, whose session has no frame yet.
        pieces: The pieces in order.
        mapped: Their maps, one after the other.
        settings: Those of the drive.
    """
    session = map_.session()
    detector = LoopDetector(session.keyframes, search=settings.loops.enabled)
    for piece, one in zip(pieces, mapped, strict=True):
        part = one.session()
        if not len(session):
            session.set_axes(part.T_map_world, part.camera)
        T_world_part = _append_frames(session, part, piece)
        rays = [key for key in one.store.keys(RAYS) if isinstance(key, tuple)]
        kept: dict[Key, Key] = {
            key: (session.number, piece.first + key[1]) for key in rays if key[1] >= piece.lead
        }
        one.store.copy(RAYS, map_.store, kept)
        for submap in part.submaps:
            _append_submap(session, submap, piece, T_world_part, settings)
        for keyframe in _keyframes(session, part, piece):
            detector.look(keyframe, session.camera)


def joined_drive(source: StereoSource, settings: DriveSettings, work: Workspace) -> MappedSequence:
    """Return a drive that was joined from pieces, as if it had been mapped in one.

    Its occupancy is made from its rays, as where each was seen is known only now.
    """
    session = work.map.session()
    reconstructor = FrameReconstructor(source.calibration, settings, threads=work.threads)
    return MappedSequence(
        map=work.map,
        config=settings,
        sample=reconstructor.reconstruct(next(source.frames(len(source) // 2))),
        seconds=(session.state() or {})["seconds"],
        loops=_close_loops(session, work) if settings.loops.enabled else None,
        threads=work.threads or 1,
    )


def _append_frames(session: Session, part: Session, piece: Piece) -> Float64:
    """Add the frames behind the lead of a piece to a drive; returns ``T_world_part`` (4, 4)."""
    path, health, T_world_part = part.odometry, part.health, _place(session, part, piece)
    for number in range(piece.lead, len(part)):
        T_part_camera = path.T_world_camera[number]
        moved = orthonormalise(T_world_part @ T_part_camera) if piece.lead else T_part_camera
        session.add_frame(moved, float(path.timestamps_s[number]), health[number])
    return T_world_part


def _place(session: Session, part: Session, piece: Piece) -> Float64:
    """Return where a piece is: the pose of its last lead that both have measured is the same."""
    if not piece.lead:
        return np.eye(4)
    before, health = session.odometry.T_world_camera, session.health
    measured = [
        number
        for number in range(piece.lead)
        if health[piece.first + number].ok and part.health[number].ok
    ]
    shared = max(measured, default=piece.lead - 1)
    T_part_world = part.odometry.T_world_camera[shared] @ invert(before[piece.first + shared])
    return orthonormalise(invert(T_part_world))


def _append_submap(
    session: Session, submap: Submap, piece: Piece, T_world_part: Float64, settings: DriveSettings
) -> None:
    """Add what a piece fused to a drive; its cast rays are left out, see `joined_drive`."""
    lead = max(0, piece.lead - submap.first_frame)
    if submap.frames <= lead:
        return
    nothing, fused = np.zeros(len(submap.occupancy.rows.blocks), np.bool_), submap.fused
    if piece.lead:
        fused = fused.moved(T_world_part, settings.fusion.voxel_m).rounded()
    number, first, frames = len(session.submaps), session.submaps.frames, submap.frames - lead
    kept = Submap(number, first, frames, fused, submap.occupancy.select(nothing))
    session.submaps.add(kept)


def _keyframes(session: Session, part: Session, piece: Piece) -> Iterator[StoredKeyframe]:
    """Return the keyframes of a piece behind its lead, as those of the drive."""
    poses, health = session.odometry.T_world_camera, session.health
    path_m = path_lengths(poses, np.array([record.ok for record in health]))
    for stored in part.keyframes:
        frame = piece.first + stored.keyframe.frame
        if stored.keyframe.frame >= piece.lead:
            keyframe = replace(stored.keyframe, frame=frame)
            yield StoredKeyframe(keyframe, poses[frame], float(path_m[frame]))


def _close_loops(session: Session, work: Workspace) -> DriveLoops:
    """Close the loops that were found in a drive."""
    with work.stopwatch.stage("close_loops"):
        watch = LoopWatch(session.keyframes)
        try:
            watch.restore(session.odometry.T_world_camera, session.trusted.tolist())
            loops = watch.close(session.odometry)
        finally:
            watch.stop()
        session.set_loops(loops.record())
        return loops
