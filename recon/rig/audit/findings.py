"""The findings of an audit, each a problem with advice, and the verdict that follows from them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from recon.core.text import counted
from recon.core.values import LARGEST_CENTRE_OFFSET, RectifiedCamera, Rig
from recon.rig.audit.corrections import RightTurn
from recon.rig.audit.measures import Gaps
from recon.rig.audit.sample import BLANK_DN, MIN_FEATURES, Geometry, Sample
from recon.rig.audit.seen_motion import turn_figures
from recon.sources.source import StereoSource
from recon.stereo.match.protocol import Matcher

Verdict = Literal["good", "usable", "not usable"]
_SIDES = ("left", "right")


_SWAPPED_SHARE: Final = 0.8
"""Share of negative disparities from which the cameras count as swapped."""

_ROW_PX: Final = 0.75
"""Rms row error above which it is reported."""

_BAD_ROW_PX: Final = 1.5
"""Rms row error above which that finding is fatal."""

_DISPARITY_PX: Final = 0.75
"""Error common to all disparities above which it is reported."""

_GAIN: Final = 1.2
"""Brightness ratio above which a finding is reported."""

_SHARPNESS_RATIO: Final = 0.65
"""One camera counts as blurred below this sharpness relative to the other."""

_SHARPNESS: Final = 0.14
"""Both cameras count as blurred below this sharpness."""

_REPEATED_SHARE: Final = 0.02
"""Share of repeated frames that is still accepted."""

_FROZEN_FRAMES: Final = 3
"""Repeats in a row from which one camera counts as frozen."""

_SKEW_FRAMES: Final = 0.1
"""Time skew between the cameras above which it is reported, in frames."""

_NEAR_SHARE: Final = 0.02
"""Share of features beyond the disparity range above which they are reported."""

_FAR_PX: Final = 1.5
"""A scene with a smaller median disparity is too far for the baseline."""

_MAX_SPEED_M_PER_S: Final = 70.0
"""A higher apparent speed means that the baseline is wrong."""


@dataclass(frozen=True)
class Finding:
    """One problem of a recording.

    Attributes:
        code: Kind of problem, one word, for programs.
        fatal: Whether the problem makes depth wrong or impossible.
        text: Description and advice, for people.
    """

    code: str
    fatal: bool
    text: str


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return good without findings, not usable with a fatal one, else usable."""
    found = list(findings)
    if any(finding.fatal for finding in found):
        return "not usable"
    return "usable" if found else "good"


def find_image_faults(sample: Sample, matcher: str | Matcher) -> Iterator[Finding]:
    """Yield problems of single images: unreadable, black, blurred, of unequal brightness."""
    if sample.broken is not None:
        code = "size" if "size" in sample.broken.what else "unreadable"
        yield Finding(code, True, str(sample.broken))
    for side in _blank_sides(sample):
        mean = np.median([pair[side] for pair in sample.brightness_dn])
        yield Finding(
            "black",
            True,
            f"the {_SIDES[side]} camera shows nothing: its images are uniform, at grey level "
            f"{mean:.0f} of 255; check its cable, its lens cap and its exposure "
            "(16-bit images must fill their range)",
        )
    yield from _find_blur(sample)
    gains = np.concatenate([np.zeros(0), *sample.gains])
    if len(gains) >= MIN_FEATURES:
        gain = float(np.median(gains))
        if not 1 / _GAIN < gain < _GAIN:
            # The census transform of sgm compares grey levels only with their neighbours.
            other = "" if matcher == "sgm" else ", or match with sgm"
            yield Finding(
                "gain",
                False,
                f"the right camera is {gain:.2f} times as bright as the left one; give both the "
                f"same fixed exposure and gain{other}",
            )


def _blank_sides(sample: Sample) -> list[int]:
    """Return cameras whose images are uniform in most pairs."""
    blank = np.array(sample.contrast_dn).reshape(-1, 2) < BLANK_DN
    return [side for side in range(2) if len(blank) and blank[:, side].mean() >= 0.5]


def _find_blur(sample: Sample) -> Iterator[Finding]:
    if not sample.sharpness:
        return
    left, right = np.median(sample.sharpness, axis=0)
    worse = _SIDES[int(right < left)]
    if min(left, right) < _SHARPNESS_RATIO * max(left, right):
        yield Finding(
            "blur",
            False,
            f"the {worse} camera is blurred: sharpness {min(left, right):.2f}, the other "
            f"{max(left, right):.2f}; focus it or clean its lens",
        )
    elif max(left, right) < _SHARPNESS:
        yield Finding(
            "blur",
            False,
            f"both cameras are blurred: sharpness {left:.2f} and {right:.2f}, expected above "
            f"{_SHARPNESS:g}; focus them, expose shorter, or halve the image size",
        )


def find_series_faults(sample: Sample, gaps: Gaps) -> Iterator[Finding]:
    """Yield problems of the sequence: repeated frames, frozen cameras, gaps."""
    repeats = sample.repeats
    if repeats.steps and repeats.both > _REPEATED_SHARE * repeats.steps:
        yield Finding(
            "duplicates",
            False,
            f"{repeats.both} of {counted(repeats.steps, 'frame')} repeat the previous one; the "
            "recorder wrote frames twice, or the rig stood still: drop them, or record at the "
            "cameras' own rate",
        )
    blank = _blank_sides(sample)
    for side, run in enumerate(repeats.frozen):
        # A camera with uniform images would count as frozen, too.
        if run >= _FROZEN_FRAMES and side not in blank:
            yield Finding(
                "frozen",
                True,
                f"the {_SIDES[side]} camera is frozen for {counted(run, 'frame')} while the other "
                "goes on; it hung or lost frames: record again",
            )
    if gaps.count:
        yield Finding(
            "gaps",
            False,
            f"frames are missing at {counted(gaps.count, 'place')}, at most {gaps.longest_s:.2f} s "
            f"after frame {gaps.after} (usual {gaps.usual_s:.3f} s); the path may jump there",
        )


def find_geometry_faults(geometry: Geometry, source: StereoSource) -> Iterator[Finding]:
    """Yield problems of the geometry: swapped cameras, delays, row errors."""
    swapped, lag, skew = geometry.swapped_share, geometry.lag, geometry.skew
    if swapped >= _SWAPPED_SHARE:
        yield Finding(
            "swapped",
            True,
            f"left and right are swapped: {100 * swapped:.0f} % of the near features are farther "
            "right in the right image; exchange --left and --right (or un-mirror the images)",
        )
    if lag:
        late = "right" if lag > 0 else "left"
        yield Finding(
            "lag",
            True,
            f"the {late} camera is {counted(abs(lag), 'frame')} late; " + _in_step(source, lag),
        )
    elif skew is not None and abs(skew[0]) > max(_SKEW_FRAMES, 4 * skew[1]):
        yield Finding(
            "skew",
            False,
            f"the right images are taken {skew[0]:+.2f} frames after the left ones; trigger "
            "both cameras together, or drive slowly",
        )
    yield from _find_row_faults(geometry)


def _in_step(source: StereoSource, lag: int) -> str:
    """Return how the images of two cameras come to belong together."""
    shift = source.shift_of(lag)
    if shift is None:
        return "pair the images by timestamp"
    return f"--set source.shift_frames={shift} pairs the images that belong together"


def _find_row_faults(geometry: Geometry) -> Iterator[Finding]:
    alignment = geometry.alignment
    if alignment is None:
        if not geometry.pairs:
            return
        yield Finding(
            "features",
            False,
            f"too few features match between left and right ({geometry.matched} matched) to check "
            "the geometry: the images show too little texture, or different scenes",
        )
    elif alignment.rms_px > _ROW_PX:
        pitch, roll = np.degrees([alignment.pitch_rad, alignment.roll_rad])
        yield Finding(
            "rows",
            alignment.rms_px > _BAD_ROW_PX,
            f"rows of left and right are not aligned: {alignment.rms_px:.2f} px rms, mean "
            f"{alignment.mean_px:+.2f} px, spread {alignment.spread_px:.2f} px; rotating the right "
            f"camera by {pitch:+.3f} deg pitch and {roll:+.3f} deg roll corrects this: "
            "recon audit --mend FILE",
        )


def find_turn_faults(turn: RightTurn | None, camera: RectifiedCamera) -> Iterator[Finding]:
    """Yield a right camera that is turned about the vertical, as the motion shows it."""
    if turn is None:
        return
    figures = turn_figures(turn, camera)
    off, sigma = figures["disparity_px"]["value"], figures["disparity_px"]["sigma"]
    if abs(off) > max(_DISPARITY_PX, 4 * sigma):
        depths = ", ".join(f"{p:+.1f} % at {z} m" for z, p in figures["depth_percent"].items())
        yield Finding(
            "yaw",
            False,
            f"disparities are {-off:+.2f} ± {1.96 * sigma:.2f} px off, as the motion shows: depth "
            f"is off by {depths}; turning the right camera by {figures['yaw_deg']['value']:+.3f} "
            "deg yaw corrects this: recon audit --mend FILE",
        )


def find_range_faults(
    geometry: Geometry, reach_px: int | None, camera: RectifiedCamera
) -> Iterator[Finding]:
    """Yield scenes that are too near or too far for the rig.

    Args:
        geometry: Measures of the matched features.
        reach_px: Largest disparity that will be searched, if that is fixed.
        camera: The rectified camera.
    """
    disparity_px = geometry.disparity_px
    if len(disparity_px) < MIN_FEATURES:
        return
    scale = camera.focal_px * camera.baseline_m
    # A matcher's disparity is in image columns, without doffs.
    columns_px = disparity_px - camera.doffs_px
    near = float(np.mean(columns_px > reach_px)) if reach_px else 0.0
    if reach_px and near > _NEAR_SHARE:
        reach_m = scale / (reach_px + camera.doffs_px)
        most = int(np.ceil(np.quantile(columns_px, 0.98) / 16) * 16)
        yield Finding(
            "near",
            False,
            f"{100 * near:.0f} % of the features are nearer than the disparity range covers "
            f"({reach_px} px, {reach_m:.1f} m); give the matcher an ndisp of {most}",
        )
    middle = float(np.median(disparity_px))
    if 0 < middle < _FAR_PX:
        yield Finding(
            "far",
            False,
            f"half of the features are farther away than {scale / middle:.0f} m, at less than "
            f"{middle:.1f} px of disparity: the baseline of {camera.baseline_m:.3g} m is too short "
            "for this scene",
        )


def find_calibration_faults(
    sample: Sample,
    rig: Rig,
    camera: RectifiedCamera,
    baseline_m: tuple[float, float],
) -> Iterator[Finding]:
    """Yield implausible calibration: image size, baseline outside of the plausible ones."""
    for name, centre, size in _centres(rig):
        off = np.abs(np.array(centre) / size - 0.5)
        if off.max() > LARGEST_CENTRE_OFFSET:
            yield Finding(
                "size",
                True,
                f"the calibration is of another size: principal point of the {name} camera at "
                f"({centre[0]:.0f}, {centre[1]:.0f}) of {size[0]}x{size[1]} pixels; scale it, or "
                "use images of the calibrated size",
            )
            break
    shortest, longest = baseline_m
    speed = float(np.median(sample.speeds_m_per_s)) if sample.speeds_m_per_s else 0.0
    long = not shortest <= camera.baseline_m <= longest
    if long or speed > _MAX_SPEED_M_PER_S:
        moving = f", with which the rig moves at {speed:.0f} m/s" if speed > 0 else ""
        yield Finding(
            "baseline",
            True,
            f"the baseline is implausible: {camera.baseline_m:.4g} m{moving}; check the unit of "
            "the calibration (--set source.metres_per_unit=0.001 for an OpenCV file in mm)",
        )


def _centres(
    rig: Rig,
) -> list[tuple[str, tuple[float, float], tuple[int, int]]]:
    if isinstance(rig, RectifiedCamera):
        size = (rig.width_px, rig.height_px)
        return [("left", (rig.cx_px, rig.cy_px), size)]
    return [
        (name, (float(c.matrix[0, 2]), float(c.matrix[1, 2])), (c.width_px, c.height_px))
        for name, c in zip(_SIDES, (rig.left, rig.right), strict=True)
    ]
