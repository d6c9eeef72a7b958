"""Localisation frame by frame: search until a place is recognised, then track against the map.

Where the map confirms nothing, odometry goes on alone until its drift makes the pose uncertain.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

import numpy as np

from recon.core.geometry.se3 import covariance_of, invert, step_covariance
from recon.core.text import counted
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Bool, Float64
from recon.map.localize.belief import MAX_SIGMA_M, Belief
from recon.map.localize.surroundings import Surroundings
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.odometry.visual import VisualEstimate, VisualOdometry
from recon.places.closure import loop_bias
from recon.places.detector import KnownPlaces
from recon.places.keyframe import Keyframe, make_keyframe
from recon.places.places import Loop, agreeing_loops, path_lengths

_VIEWS: Final = 2  # nearest views of the map that each frame is compared with
_SURFACES_EVERY: Final = 3
"""Frames between two corrections by surfaces, where features confirm the pose."""
_SURE_SIGMA_M: Final = 0.5 * MAX_SIGMA_M  # on a road, as the next
"""Poses that are more certain than this need not be compared with the map if time is short."""
_CONTRADICTS: Final = "the map contradicts the odometry"
_ANYWHERE: Final = 10
"""Most views that look alike which are compared with a frame behind a break, if there is time."""
_LOST_SIGMA_M: Final = 0.05
"""Standard deviation of a motion without features, beside the drift over it."""
_LOST_SIGMA_DEG: Final = 0.3  # that of its rotation


class State(str, Enum):
    """What is known of a frame's place."""

    SEARCHING = "searching"  # nothing; no place has been recognised for certain
    TRACKING = "tracking"  # its pose; views or surfaces of the map confirm it
    COASTING = "coasting"  # its pose by odometry alone since the last one that was confirmed
    LOST = "lost"  # nothing any more; the pose of the frame before was the last one


@dataclass(frozen=True, eq=False)
class Located:
    """Where a frame is in a map."""

    state: State  # what is known
    # float64 (4, 4), in the world of the map; None unless it is tracked or coasting
    T_world_camera: Float64 | None = None
    # float64 (6, 6) of a step (translation in metres, rotation vector in radians) in camera axes;
    # None where there is no pose. While coasting it grows with the way.
    covariance: Float64 | None = None
    views: int = 0  # views of the map that confirm the pose
    inliers: int = 0  # features that agree with them
    surfaces: bool = False  # whether the surfaces of the map confirm and corrected the pose
    note: str = ""  # why nothing is known, or confirmed

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position, of its three axes together; NaN where unknown."""
        if self.covariance is None:
            return float("nan")
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    def __repr__(self) -> str:
        parts = [self.state.value, *([self.note] if self.note else [])]
        if self.T_world_camera is not None:
            at = " ".join(f"{metres:.5g}" for metres in self.T_world_camera[:3, 3])
            parts += [f"at {at} m, sigma {self.sigma_m:.2g} m, {counted(self.inliers, 'inlier')}"]
        return f"Located({', '.join(parts)})"


@dataclass(frozen=True, eq=False)
class _Confirmed:
    """A belief after what the map shows in a frame, with the loops that confirm it."""

    belief: Belief
    loops: tuple[Loop, ...] = ()
    refused: str = ""
    surfaces: bool = False
    contradicted: bool = False  # whether more views show the place elsewhere


class Localizer:
    """Finds the frames of a drive in a map, which it does not change.

    Visual odometry predicts each pose; features of the nearest views of the map, and its surfaces
    (unless they are None), correct it, by their covariances. A pose is given out only while it is
    certain; where nothing corrects it, that is as far as odometry drifts by so much, some metres.
    Where frames are matched roughly, since time is short, one view corrects them; surfaces do only
    if none is found. On the first fix at least ``frames`` must agree, by the views ``among`` (N,),
    None = all.
    """

    def __init__(
        self,
        known: KnownPlaces,
        surroundings: Surroundings | None = None,
        *,
        frames: int = 2,
        among: Bool | None = None,
    ) -> None:
        self._known = known
        self._surroundings = surroundings
        self._needed = frames
        self._first_fix = FirstFix(known, frames, among)
        self._visual = VisualOdometry()
        self._belief: Belief | None = None
        self._T_odometry = np.eye(4)
        self.odometry = OdometryResult(np.eye(4))  # of the last frame, which no map corrects
        self._path_m = 0.0
        self._frames = self._breaks = 0

    @property
    def views(self) -> Float64:
        """float64 (N, 4, 4), ``T_world_camera`` of the views of the map."""
        return self._known.T_world_camera

    def restart(self, among: Bool) -> None:
        """Forget where the drive is: it is looked for among some of the `views`, bool (N,)."""
        self._belief, self._first_fix = None, FirstFix(self._known, self._needed, among)

    def add(self, frame: OdometryFrame, *, hurried: Callable[[], bool] = lambda: False) -> Located:
        """Locate the next frame.

        If ``hurried`` says so once odometry has moved it, and it is certain enough where that is,
        the frame is not compared with the map.
        """
        visual = self._visual.track(frame)
        self._advance(visual)
        self._frames += 1
        sure_m = self._known.scale * _SURE_SIGMA_M
        if self._belief is not None and self._belief.sigma_m <= sure_m and hurried():
            return self._result(
                _Confirmed(self._belief, refused="no time left to match against the map")
            )
        keyframe = make_keyframe(self._frames - 1, frame.pair, frame.disparity)
        lost = None
        if self._belief is not None:
            confirmed = self._confirm(self._belief, keyframe, frame)
            if confirmed.contradicted:
                # If several views say the same they are believed, and odometry is not.
                self._breaks += 1
                self._belief, lost = None, Located(State.LOST, note=confirmed.refused)
            else:
                lost = self._result(confirmed)
                if lost.state is not State.LOST:
                    return lost
        camera = frame.pair.camera
        at = (self._T_odometry, self._path_m, self._breaks)
        fix = self._first_fix.find(keyframe, camera, *at, hurried=frame.rough)
        if fix is None:
            return lost or Located(State.SEARCHING, note="no place is recognised for certain")
        begun = Belief(*self._measured(fix), scale=self._known.scale)
        confirmed = self._confirm(begun, keyframe, frame)
        return self._result(replace(confirmed, loops=confirmed.loops or (fix,)))

    def _advance(self, visual: VisualEstimate) -> None:
        T_now = visual.result.T_world_camera
        seen = visual.information is not None
        self._breaks += self._frames > 0 and not seen
        steps = np.stack([self._T_odometry, T_now])
        trusted, scale = np.array([True, seen or not self._frames]), self._known.scale
        step_m = float(path_lengths(steps, trusted, scale)[-1])
        if self._belief is not None:
            covariance = step_covariance(scale * _LOST_SIGMA_M, _LOST_SIGMA_DEG)
            if visual.information is not None:
                covariance = covariance_of(visual.information)
            T_before_now = invert(self._T_odometry) @ T_now
            self._belief = self._belief.moved(T_before_now, covariance, step_m)
        health = visual.result.health
        health = replace(health, ok=health.ok and (seen or not self._frames))
        self.odometry = replace(visual.result, health=health)
        self._T_odometry, self._path_m = T_now, self._path_m + step_m

    def _measured(self, loop: Loop) -> tuple[Float64, Float64]:
        """Return the pose by a loop from a view of the map, and its covariance."""
        T = self._known.T_world_camera[loop.first] @ loop.T_first_last
        bias = loop_bias(loop, self._known.scale)
        return T, covariance_of(loop.information) + bias.covariance

    def _confirm(self, belief: Belief, keyframe: Keyframe, frame: OdometryFrame) -> _Confirmed:
        """Return the belief, corrected by the nearest views of the map and its surfaces."""
        loops, against, refused = dict[int, Loop](), set[int](), ""

        def weighed(belief: Belief, loop: Loop) -> Belief:
            corrected = belief.corrected_to(*self._measured(loop))
            if corrected is None:
                against.add(loop.first)
            elif loop.first not in loops:
                loops[loop.first] = loop
                return corrected
            return belief

        for number in self._known.near(belief.T_world_camera, _VIEWS):
            verdict = self._known.compare(number, keyframe, frame.pair.camera)
            if verdict.loop is None:
                refused = verdict.refused
                continue
            belief = weighed(belief, verdict.loop)
            if frame.rough and loops:  # one tells most of it, and in a hurry time counts
                break
        if not frame.rough and (against or not loops):
            for loop in self._known.recognise(keyframe, frame.pair.camera).loops:
                belief = weighed(belief, loop)
        refused = _CONTRADICTS if against else refused
        if len(against) > len(loops) and not frame.rough:
            return _Confirmed(belief, refused=refused, contradicted=True)
        # Aligning takes as long as several frames may, where they are in a hurry.
        due = not loops or (not frame.rough and self._frames % _SURFACES_EVERY == 0)
        by_surfaces = None
        if self._surroundings is not None and due:
            by_surfaces = self._surroundings.correct(belief, frame, learn=bool(loops))
        found = tuple(loops.values())
        return _Confirmed(by_surfaces or belief, found, refused, by_surfaces is not None)

    def _result(self, confirmed: _Confirmed) -> Located:
        belief, seen = confirmed.belief, bool(confirmed.loops) or confirmed.surfaces
        why = "" if seen else confirmed.refused or "no view of the map is near"
        if not belief.certain:
            self._belief = None
            return Located(State.LOST, note=why or "the covariance of the pose is too large")
        self._belief = belief
        return Located(
            State.TRACKING if seen else State.COASTING,
            belief.T_world_camera,
            belief.covariance,
            len(confirmed.loops),
            sum(loop.inliers for loop in confirmed.loops),
            confirmed.surfaces,
            why,
        )


_REMEMBERED: Final = 10  # frames whose recognised places still count
_NEIGHBOURS: Final = 3  # views around a recognised place that must show it, too


class FirstFix:
    """Looks for a drive in a map until enough of its frames agree where they are.

    Where two places look alike both are found, contradict each other, and neither is believed.
    """

    def __init__(self, known: KnownPlaces, frames: int, among: Bool | None) -> None:
        self._known = known
        self._frames = frames
        self._among = among
        self._seen: deque[tuple[tuple[Float64, float, int], list[Loop]]] = deque(maxlen=_REMEMBERED)

    def find(
        self,
        keyframe: Keyframe,
        camera: RectifiedCamera,
        T_odometry_camera: Float64,
        path_m: float,
        breaks: int = 0,
        *,
        hurried: bool = False,
    ) -> Loop | None:
        """Return the best believed loop to the next frame, ``path_m`` into the drive, if any.

        Behind a break of the odometry several views of the map are enough.
        """
        at = (T_odometry_camera, path_m, breaks)
        options = {"most": _ANYWHERE} if breaks and not hurried else {}
        recognised = self._known.recognise(keyframe, camera, self._among, **options)
        found = {loop.first: loop for loop in recognised.loops}
        for loop in [*found.values()]:
            # Views around a recognised one must show the place, too.
            T_world_camera = self._known.T_world_camera[loop.first] @ loop.T_first_last
            for number in self._known.near(T_world_camera, _NEIGHBOURS):
                other = None if number in found else self._known.compare(number, keyframe, camera)
                if other is not None and other.loop is not None:
                    found[number] = other.loop
        self._seen.append((at, [*found.values()]))
        loops = [loop for _, loops in self._seen for loop in loops]
        # The map is a rigid thing: only the drive in it drifts.
        firsts = {loop.first: (self._known.T_world_camera[loop.first], 0.0, 0) for loop in loops}
        lasts = {loop.last: at for at, loops in self._seen for loop in loops}
        alone = breaks > 0 and sum(at[2] == breaks for at, _ in self._seen) == 1
        needed, scale = 1 if alone else self._frames, self._known.scale
        agreeing = agreeing_loops(loops, firsts, lasts, keyframes=needed, scale=scale)
        believed = [loop for loop in agreeing if loop.last == keyframe.frame]
        if not believed:
            return None
        self._seen.clear()
        self._among = None  # once lost, the drive may be anywhere
        return max(believed, key=lambda loop: loop.inliers)
