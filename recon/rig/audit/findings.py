"""The findings of an audit, each a problem with advice, and the verdict that follows from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
_SWAPPED_SHARE: Final = 0.8  # share of negative disparities from which the cameras count as swapped
_ROW_PX: Final = 0.75  # rms row error above which it is reported
_BAD_ROW_PX: Final = 1.5  # rms row error above which that finding is fatal
_DISPARITY_PX: Final = 0.75  # error common to all disparities above which it is reported
_GAIN: Final = 1.2  # brightness ratio above which a finding is reported
# One camera counts as blurred below this sharpness relative to the other.
_SHARPNESS_RATIO: Final = 0.65
_SHARPNESS: Final = 0.14  # both cameras count as blurred below this sharpness
_REPEATED_SHARE: Final = 0.02  # share of repeated frames that is still accepted
_FROZEN_FRAMES: Final = 3  # repeats in a row from which one camera counts as frozen
_SKEW_FRAMES: Final = 0.1  # time skew between the cameras above which it is reported, in frames
# Share of features beyond the disparity range above which they are reported.
_NEAR_SHARE: Final = 0.02
_FAR_PX: Final = 1.5  # a scene with a smaller median disparity is too far for the baseline
_MAX_SPEED_M_PER_S: Final = 70.0  # a higher apparent speed means that the baseline is wrong
_TEXTS: Final = {
    "black": "the {side} camera shows nothing: its images are uniform, at grey level {mean:.0f} of "
    "255; check its cable, its lens cap and its exposure (16-bit images must fill their range)",
    "gain": "the right camera is {gain:.2f} times as bright as the left one; give both the same "
    "fixed exposure and gain{other}",
    "blur": "the {side} camera is blurred: sharpness {worse:.2f}, the other {better:.2f}; focus it "
    "or clean its lens",
    "duplicates": "{repeated} of {steps} repeat the previous one; the recorder wrote frames twice, "
    "or the rig stood still: drop them, or record at the cameras' own rate",
    "frozen": "the {side} camera is frozen for {run} while the other goes on; it hung or lost "
    "frames: record again",
    "gaps": "frames are missing at {places}, at most {gaps.longest_s:.2f} s after frame "
    "{gaps.after} (usual {gaps.usual_s:.3f} s); the path may jump there",
    "swapped": "left and right are swapped: {percent:.0f} % of the near features are farther right "
    "in the right image; exchange --left and --right (or un-mirror the images)",
    "lag": "the {late} camera is {frames} late; {in_step}",
    "skew": "the right images are taken {skew:+.2f} frames after the left ones; trigger both "
    "cameras together, or drive slowly",
    "features": "too few features match between left and right ({matched} matched) to check the "
    "geometry: the images show too little texture, or different scenes",
    "rows": "rows of left and right are not aligned: {rows.rms_px:.2f} px rms, mean "
    "{rows.mean_px:+.2f} px, spread {rows.spread_px:.2f} px; rotating the right camera by "
    "{pitch:+.3f} deg pitch and {roll:+.3f} deg roll corrects this: recon audit --mend FILE",
    "yaw": "disparities are {off:+.2f} ± {limit:.2f} px off, as the motion shows: depth is off by "
    "{depths}; turning the right camera by {yaw:+.3f} deg yaw corrects this: "
    "recon audit --mend FILE",
    "near": "{percent:.0f} % of the features are nearer than the disparity range covers "
    "({reach_px} px, {reach_m:.1f} m); give the matcher an ndisp of {most}",
    "far": "half of the features are farther away than {depth_m:.0f} m, at less than "
    "{middle:.1f} px of disparity: the baseline of {baseline_m:.3g} m is too short for this scene",
    "size": "the calibration is of another size: principal point of the {side} camera at "
    "({x:.0f}, {y:.0f}) of {width}x{height} pixels; scale it, or use images of the calibrated size",
    "baseline": "the baseline is implausible: {baseline_m:.4g} m{moving}; check the unit of the "
    "calibration (--set source.metres_per_unit=0.001 for an OpenCV file in mm)",
}


@dataclass(frozen=True)
class Finding:
    """One problem of a recording."""

    code: str  # kind of problem, one word, for programs
    fatal: bool  # whether the problem makes depth wrong or impossible
    text: str  # description and advice, for people


def verdict_of(findings: Sequence[Finding]) -> Verdict:
    """Return good without findings, not usable with a fatal one, else usable."""
    if any(finding.fatal for finding in findings):
        return "not usable"
    return "usable" if findings else "good"


def _fatal(code: str, **figures: object) -> Finding:
    return Finding(code, True, _TEXTS[code].format(**figures))


def _warning(code: str, **figures: object) -> Finding:
    return Finding(code, False, _TEXTS[code].format(**figures))


def find_image_faults(sample: Sample, matcher: str | Matcher) -> Iterator[Finding]:
    """Yield problems of single images: unreadable, black, blurred, of unequal brightness."""
    if sample.broken is not None:
        code = "size" if "size" in sample.broken.what else "unreadable"
        yield Finding(code, True, str(sample.broken))
    for side in _blank_sides(sample):
        mean = np.median([pair[side] for pair in sample.brightness_dn])
        yield _fatal("black", side=_SIDES[side], mean=mean)
    yield from _find_blur(sample)
    gains = np.concatenate([np.zeros(0), *sample.gains])
    gain = float(np.median(gains)) if len(gains) >= MIN_FEATURES else 1.0
    if not 1 / _GAIN < gain < _GAIN:
        # The census transform of sgm compares grey levels only with their neighbours.
        yield _warning("gain", gain=gain, other="" if matcher == "sgm" else ", or match with sgm")


def _blank_sides(sample: Sample) -> list[int]:
    """Return cameras whose images are uniform in most pairs."""
    blank = np.array(sample.contrast_dn).reshape(-1, 2) < BLANK_DN
    return [side for side in range(2) if len(blank) and blank[:, side].mean() >= 0.5]


def _find_blur(sample: Sample) -> Iterator[Finding]:
    if not sample.sharpness:
        return
    left, right = np.median(sample.sharpness, axis=0)
    worse, better = min(left, right), max(left, right)
    if worse < _SHARPNESS_RATIO * better:
        yield _warning("blur", side=_SIDES[int(right < left)], worse=worse, better=better)
    elif better < _SHARPNESS:
        text = f"both cameras are blurred: sharpness {left:.2f} and {right:.2f}, expected above "
        text += f"{_SHARPNESS:g}; focus them, expose shorter, or halve the image size"
        yield Finding("blur", False, text)


def find_series_faults(sample: Sample, gaps: Gaps) -> Iterator[Finding]:
    """Yield problems of the sequence: repeated frames, frozen cameras, gaps."""
    repeats = sample.repeats
    if repeats.steps and repeats.both > _REPEATED_SHARE * repeats.steps:
        steps = counted(repeats.steps, "frame")
        yield _warning("duplicates", repeated=repeats.both, steps=steps)
    blank = _blank_sides(sample)
    for side, run in enumerate(repeats.frozen):
        # A camera with uniform images would count as frozen, too.
        if run >= _FROZEN_FRAMES and side not in blank:
            yield _fatal("frozen", side=_SIDES[side], run=counted(run, "frame"))
    if gaps.count:
        yield _warning("gaps", places=counted(gaps.count, "place"), gaps=gaps)


def find_geometry_faults(geometry: Geometry, source: StereoSource) -> Iterator[Finding]:
    """Yield problems of the geometry: swapped cameras, delays, row errors."""
    swapped, lag, skew = geometry.swapped_share, geometry.lag, geometry.skew
    if swapped >= _SWAPPED_SHARE:
        yield _fatal("swapped", percent=100 * swapped)
    if lag:
        late, frames = "right" if lag > 0 else "left", counted(abs(lag), "frame")
        yield _fatal("lag", late=late, frames=frames, in_step=_in_step(source, lag))
    elif skew is not None and abs(skew[0]) > max(_SKEW_FRAMES, 4 * skew[1]):
        yield _warning("skew", skew=skew[0])
    rows = geometry.alignment
    if rows is None and geometry.pairs:
        yield _warning("features", matched=geometry.matched)
    elif rows is not None and rows.rms_px > _ROW_PX:
        pitch, roll = np.degrees([rows.pitch_rad, rows.roll_rad])
        severity = _fatal if rows.rms_px > _BAD_ROW_PX else _warning
        yield severity("rows", rows=rows, pitch=pitch, roll=roll)


def _in_step(source: StereoSource, lag: int) -> str:
    shift = source.shift_of(lag)
    if shift is None:
        return "pair the images by timestamp"
    return f"--set source.shift_frames={shift} pairs the images that belong together"


def find_turn_faults(turn: RightTurn | None, camera: RectifiedCamera) -> Iterator[Finding]:
    """Yield a right camera that is turned about the vertical, as the motion shows it."""
    if turn is None:
        return
    figures = turn_figures(turn, camera)
    off, sigma = figures["disparity_px"]["value"], figures["disparity_px"]["sigma"]
    if abs(off) > max(_DISPARITY_PX, 4 * sigma):
        depths = ", ".join(f"{p:+.1f} % at {z} m" for z, p in figures["depth_percent"].items())
        yaw = figures["yaw_deg"]["value"]
        yield _warning("yaw", off=-off, limit=1.96 * sigma, depths=depths, yaw=yaw)


def find_range_faults(
    geometry: Geometry, reach_px: int | None, camera: RectifiedCamera
) -> Iterator[Finding]:
    """Yield scenes that are too near or too far for the rig.

    ``reach_px`` is the largest disparity that will be searched, if that is fixed.
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
        yield _warning("near", percent=100 * near, reach_px=reach_px, reach_m=reach_m, most=most)
    middle = float(np.median(disparity_px))
    if 0 < middle < _FAR_PX:
        depth_m, baseline_m = scale / middle, camera.baseline_m
        yield _warning("far", depth_m=depth_m, middle=middle, baseline_m=baseline_m)


def find_calibration_faults(
    sample: Sample, rig: Rig, camera: RectifiedCamera, baseline_m: tuple[float, float]
) -> Iterator[Finding]:
    """Yield implausible calibration: image size, baseline outside of the plausible ones."""
    for side, (x, y), (width, height) in _centres(rig):
        off = np.abs(np.array([x, y]) / (width, height) - 0.5)
        if off.max() > LARGEST_CENTRE_OFFSET:
            yield _fatal("size", side=side, x=x, y=y, width=width, height=height)
            break
    shortest, longest = baseline_m
    speed = float(np.median(sample.speeds_m_per_s)) if sample.speeds_m_per_s else 0.0
    if not shortest <= camera.baseline_m <= longest or speed > _MAX_SPEED_M_PER_S:
        moving = f", with which the rig moves at {speed:.0f} m/s" if speed > 0 else ""
        yield _fatal("baseline", baseline_m=camera.baseline_m, moving=moving)


def _centres(rig: Rig) -> list[tuple[str, tuple[float, float], tuple[int, int]]]:
    """Return name, principal point and image size of each camera."""
    if isinstance(rig, RectifiedCamera):
        return [("left", (rig.cx_px, rig.cy_px), (rig.width_px, rig.height_px))]
    return [
        (name, (float(c.matrix[0, 2]), float(c.matrix[1, 2])), (c.width_px, c.height_px))
        for name, c in zip(_SIDES, (rig.left, rig.right), strict=True)
    ]
