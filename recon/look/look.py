"""One look at a drive before anything is made of it.

A few windows of frames, evenly spread, are read, rectified and matched once. What is wrong with the
recording, which camera is late, what the rig is and how large the scene is follow from that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Final

import numpy as np

from recon.core.errors import ReconError
from recon.core.progress import tracked
from recon.core.text import counted
from recon.core.values import Recorded, RectifiedCamera, Rig
from recon.core.values.arrays import Float64
from recon.core.work import FEW, serial_algebra, side_by_side
from recon.look.fault import TURN
from recon.look.geometry import Geometry, measure_geometry, measure_rigidity
from recon.look.rig import LEAST_FRAMES, KnownRig, RefinedRig, Tracked, refine
from recon.look.sample import (
    QUICK,
    THOROUGH,
    Extent,
    Gaps,
    Sample,
    Sampler,
    Window,
    align_features,
    choose,
    find_gaps,
    plan_windows,
)
from recon.look.tracks import StereoTracks, Tracking
from recon.odometry.settings import RigSettings
from recon.sources.source import StereoSource, check_source
from recon.stereo.frame import FrameReconstructor, StereoSettings
from recon.stereo.rectify.epipolar import correct_rig
from recon.stereo.rectify.features import match_features
from recon.stereo.rectify.rectifier import Rectifier, turns_of

_MATCHED_ROWS_PX: Final = 0.3  # rms epipolar error that does not spoil matching


@dataclass(frozen=True, eq=False)
class Look:
    """What a drive shows in windows of frames from all over it."""

    source: StereoSource  # with cameras that are whole frames apart, as images belong together
    camera: RectifiedCamera  # its rectified views, by the calibration given
    sample: Sample  # what was measured in single pairs
    geometry: Geometry  # what all features show together
    rig: RefinedRig  # as given, and as the motion shows it
    gaps: Gaps  # frames that are missing, by their timestamps
    shifted: int = 0  # by how many frames right images were taken later than they were paired

    @property
    def recorded(self) -> Sequence[Recorded]:
        """A few pairs, evenly spread, as recorded."""
        return self.sample.recorded

    @property
    def skew(self) -> tuple[float, float] | None:
        """Frames by which right images are late, and the standard error: by motion, else rows."""
        fitted = self.rig.fitted
        return (
            self.geometry.skew if fitted is None else (fitted.time_offset, fitted.time_offset_sigma)
        )

    @property
    def first(self) -> tuple[str, ...]:
        """What to know first of all: cameras that are apart in time, or move; else empty."""
        if not self.shifted:
            return self.rig.not_rigid
        late = "right" if self.shifted > 0 else "left"
        by = counted(abs(self.shifted), "frame")
        shift = f"source.shift_frames={self.source.shift_of(0)}"
        line = f"the {late} camera is {by} late: its images are paired with those of {by} before"
        return (f"{line} ({shift}); trigger both cameras together", *self.rig.not_rigid)


def look_at(
    source: StereoSource,
    config: StereoSettings,
    rig: RigSettings | None = None,
    *,
    known: KnownRig | None = None,
    extent: Extent = QUICK,
) -> Look:
    """Look at a drive before it is mapped, localized or audited.

    Where one camera is late by whole frames for certain, the drive that is returned has its images
    paired as they belong together, and the look is one at that.

    Args:
        source: The drive. Of a live one nothing is read, of a camera with depth nothing measured.
        config: How pairs are rectified and matched.
        rig: Whether the rig that the motion shows is used. Drives of less than 36 frames, and those
            whose cameras move against each other, show none. None = it is.
        known: What an earlier drive of the rig showed of it.
        extent: How many frames are read. An audit reads more, but tracks the same.

    Raises:
        ReconError: The calibration cannot rectify. An image that cannot be read ends the look, and
            is kept in ``sample.broken``.
    """
    check_source(source)
    looked = partial(_looked, config=config, rig=rig or RigSettings(), known=known)
    found = looked(source, extent=extent)
    if found.geometry.out_of_step and extent is QUICK:
        # A few pairs do not tell whole frames from half a frame, or chance.
        found = looked(source, extent=THOROUGH)
    offset = found.geometry.offset
    shifted = source.shifted(offset) if offset else None
    if shifted is None:
        return found
    again = looked(shifted, extent=extent)
    return found if again.geometry.out_of_step else replace(again, shifted=offset)


def _looked(
    source: StereoSource,
    *,
    config: StereoSettings,
    rig: RigSettings,
    known: KnownRig | None,
    extent: Extent,
) -> Look:
    given, known = source.calibration, known if rig.refine else None
    rectifier, gaps = Rectifier(given, config.rectification), find_gaps(source)
    begun = RefinedRig(given, given, rectifier.camera, period_s=gaps.usual_s)
    if known is not None:
        begun = replace(known.begun(config.rectification), period_s=gaps.usual_s)
    windows = [] if source.live else plan_windows(len(source), extent)
    used, turn, tracking = begun.calibration, np.zeros(0), None
    if windows and source.stereo and len(source) >= LEAST_FRAMES:
        used, turn = _rows_met(source, used, config, windows)
        tracking = FrameReconstructor(used, config)
    sample, tracks = _read(source, windows, rectifier, tracking, extent, shared=used is given)
    geometry = measure_geometry(sample, rectifier.camera)
    rigidity = measure_rigidity(sample, rectifier.camera, geometry.alignment)
    found = replace(begun, rigidity=rigidity)
    if tracking is not None and sample.broken is None and not found.not_rigid:
        again = partial(_track_again, source, windows, config)
        found = refine(found, Tracked(tracks, used, turn, again), config, known)
        if not rig.refine:
            found = replace(found, calibration=given)
    return Look(source, rectifier.camera, sample, geometry, found, gaps)


def _rows_met(
    source: StereoSource, rig: Rig, config: StereoSettings, windows: Sequence[Window]
) -> tuple[Rig, Float64]:
    """Return a rig with which rows meet well enough to be matched, and what turned it."""
    rectifier, alignment = Rectifier(rig, config.rectification), None
    for window in windows:
        try:
            pairs = [*islice(source.frames(window.centres[0]), 1)]
            views = [rectifier.rectify(pair) for pair in pairs]
        except ReconError:  # the look itself says so
            continue
        for view in views:
            features = match_features(view.left, view.right, QUICK.features)
            alignment = align_features(features, rectifier.camera)
        if alignment is not None:
            break
    if alignment is None or alignment.rms_px <= _MATCHED_ROWS_PX:
        return rig, np.zeros(len(TURN))
    R_left = turns_of(rig, config.rectification).R_left
    return correct_rig(rig, alignment.turn, R_left), alignment.turn


def _read(
    source: StereoSource,
    windows: Sequence[Window],
    rectifier: Rectifier,
    reconstructor: FrameReconstructor | None,
    extent: Extent,
    *,
    shared: bool,
) -> tuple[Sample, list[StereoTracks]]:
    """Read windows, side by side in threads: measure their pairs, and track features.

    ``rectifier`` is by the calibration given, ``reconstructor`` with the rig that is to be refined;
    ``shared`` = both rectify alike.
    """
    chosen = choose(windows, extent)

    def read(window: Window) -> tuple[Sample, list[StereoTracks]]:
        sampler = Sampler(window, rectifier, extent, chosen)
        tracking = None if reconstructor is None else Tracking(reconstructor)
        try:
            for number, pair in _pairs(source, window.start, window.stop):
                view = None
                if tracking is not None and window.tracked[0] <= number < window.tracked[1]:
                    view = tracking.add(pair)
                sampler.add(number, pair, view if shared else None)
        except ReconError as error:
            sampler.sample.broken = error
        return sampler.sample, [] if tracking is None else tracking.found

    with serial_algebra():
        found = side_by_side(read, windows, threads=FEW)
        parts = list(tracked(found, "windows", "look at the images", total=len(windows)))
    sample = Sample.joined(sample for sample, _ in parts)
    return sample, [one for _, tracks in parts for one in tracks]


def _track_again(
    source: StereoSource, windows: Sequence[Window], config: StereoSettings, rig: Rig
) -> list[StereoTracks]:
    """Track features through the same windows with another rig."""
    reconstructor = FrameReconstructor(rig, config)

    def track(window: Window) -> list[StereoTracks]:
        tracking = Tracking(reconstructor)
        for _, pair in _pairs(source, *window.tracked):
            tracking.add(pair)
        return tracking.found

    with serial_algebra():
        found = side_by_side(track, windows, threads=FEW)
        counts = tracked(found, "windows", "look again with another rig", total=len(windows))
        return [one for tracks in counts for one in tracks]


def _pairs(source: StereoSource, start: int, stop: int) -> Iterator[tuple[int, Recorded]]:
    return enumerate(islice(source.frames(start), stop - start), start)


def refine_rig(
    source: StereoSource, config: StereoSettings, rig: RigSettings, known: KnownRig | None = None
) -> RefinedRig:
    """Return the rig of a drive as a look at it shows; an image that cannot be read is an error."""
    look = look_at(source, config, rig, known=known)
    if look.sample.broken is not None:
        raise look.sample.broken
    return look.rig
