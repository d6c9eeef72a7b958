"""The findings of an audit, each a problem with advice, and the verdict that follows from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from recon.core.text import counted, metres
from recon.core.values import LARGEST_CENTRE_OFFSET, RectifiedCamera, Rig, StereoPair
from recon.core.values.arrays import Float64
from recon.look.look import Look
from recon.look.rig import LATER, MOST_TIME_OFFSET, MOVES, RefinedRig
from recon.look.sample import BLANK_DN, MIN_FEATURES, Gaps, Sample, measure_mosaic
from recon.look.settings import AuditedSettings, AuditSettings
from recon.sources.settings import SourceSettings
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.registry import EVENED, MatchingSettings, settings_taken
from recon.stereo.rectify.features import SWAPPED_RATIO
from recon.stereo.rectify.rectifier import shows_texture

Verdict = Literal["good", "usable", "not usable"]
Found = Iterator[tuple[str, dict[str, Any]]]  # keys of texts, and figures for them
_FATAL: Final = {"unreadable", "black", "frozen", "swapped", "lag", "nonrigid", "size"}
_SIDES = ("left", "right")
_EPIPOLAR_PX: Final = 0.75  # rms epipolar error above which it is reported
_BAD_EPIPOLAR_PX: Final = (
    1.5  # rms epipolar error above which it is fatal, unless recon map corrects it
)
_GAIN: Final = 1.2  # brightness ratio above which a finding is reported
_SHARPNESS_RATIO: Final = 0.65  # one camera counts as blurred below, relative to the other
_SHARPNESS: Final = 0.14  # both cameras count as blurred below this sharpness
_MOSAIC: Final = 1.1  # from which images are a mosaic: photographs have up to 0.8, noise 1
_REPEATED_RATIO: Final = 0.02  # fraction of repeated frames that is still accepted
_FROZEN_FRAMES: Final = 3  # repeats in a row from which one camera counts as frozen
_NEAR_RATIO: Final = 0.02  # fraction of features beyond the disparity range that is accepted
_FAR_PX: Final = 1.5  # a scene with a smaller median disparity is too far for the baseline
_MAX_SPEED_M_PER_S: Final = 70.0  # a higher apparent speed means that the baseline is wrong
# Faint texture differs by a tenth of its brightness; matching needs it at twice the noise of a dark
# image, which is about one grey level, and that of the rounding. Where more is seen than noise, a
# dark image is no fault; see `shows_texture`.
_DARK_DN: Final = 2.0 * (1.0 + 12**-0.5) / 0.1
_TEXTS: Final = {
    "unreadable": "{error}",
    "size error": "{error}",
    "black": "the {side} camera shows nothing: its images are uniform, at grey level {mean:.0f} of "
    "255; check its cable, its lens cap and its exposure (16-bit images must fill their range)",
    "mosaic": "images of the {side} camera are a Bayer mosaic: colours are to be made of it; in a "
    "bag the encoding is to say so (bayer_rggb8 …), else record them demosaiced",
    "dark": "images of the {side} camera are dark: mean grey level {mean:.0f} of 255, where faint "
    "texture is lost in noise; more light, a longer exposure (at low speed), or more gain",
    "gain": "the right camera is {gain:.2f} times as bright as the left one; give both the same "
    "fixed exposure and gain{other}",
    "blur": "the {side} camera is blurred: sharpness {worse:.2f}, the other {better:.2f}; focus it "
    "or clean its lens",
    "blur both": "both cameras are blurred: sharpness {left:.2f} and {right:.2f}, expected above "
    f"{_SHARPNESS:g}; focus them, expose shorter, or halve the image size",
    "duplicates": "{repeated} of {steps} repeat the previous one; the recorder wrote frames twice, "
    "or the rig stood still: drop them, or record at the cameras' own rate",
    "frozen": "the {side} camera is frozen for {run} while the other goes on; it hung or lost "
    "frames: record again",
    "gaps": "frames are missing at {places}, at most {gaps.longest_s:.2f} s after frame "
    "{gaps.after} (usual {gaps.usual_s:.3f} s); the path may jump there",
    "swapped": "left and right are swapped: {percent:.0f} % of the near features are farther right "
    "in the right image; exchange --left and --right (or un-mirror the images)",
    "lag": "the {late} camera is {frames} late; {in_step}",
    "lag shifted": "{paired}",
    "skew": f"the right images are taken {{skew:+.2f}} frames {LATER}; trigger both cameras "
    "together, or drive slowly",
    "nonrigid": "{found}",
    "stabilised": "{found}",
    "features": "too few features match between left and right ({matched} matched) to check the "
    "geometry: the images show too little texture, or different scenes",
    "rows": "left and right rows are not aligned: {rows.rms_px:.2f} px rms, mean "
    "{rows.mean_px:+.2f} px, spread {rows.spread_px:.2f} px; rotating the right camera by "
    "{pitch:+.3f} deg pitch and {roll:+.3f} deg roll corrects this: {who}recon audit --repair FILE "
    "writes it",
    "rig": "the rig is not as calibrated: {shown}; recon map uses the rig that the motion shows, "
    "and recon audit --repair FILE writes it",
    "near": "{percent:.0f} % of the features are nearer than the disparity range covers "
    "({reach_px} px, {reach}); give the matcher an ndisp of {most}",
    "far": "half of the features are farther away than {depth}, at less than "
    "{middle:.1f} px of disparity: the baseline of {baseline_m:.3g} m is too short for this scene",
    "size": "the calibration is of another size: principal point of the {side} camera at "
    "({x:.0f}, {y:.0f}) of {width}x{height} pixels; scale it, or use images of the calibrated size",
    "baseline": "the baseline is unusual: {baseline_m:.4g} m{moving}; if it is right, --set "
    "audit.baseline_m=[{low:g},{high:g}] says so, else check the unit of the calibration (--set "
    "source.metres_per_unit=0.001 for an OpenCV file in mm)",
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


def find_faults(look: Look, config: AuditedSettings) -> list[Finding]:
    """Return all problems, fatal ones first."""
    sample, camera, rig = look.sample, look.camera, look.source.calibration
    found = [
        *_of_images(sample, config.matching.matcher),
        *_of_series(sample, look.gaps),
        *_of_geometry(look),
        *_of_rig(look.rig, look.geometry.disparity_px),
        *_of_range(look.geometry.disparity_px, config.matching, camera),
        *_of_calibration(rig),
    ]
    # Who set the unit knows how large the rig is.
    if getattr(config, "source", SourceSettings()).metres_per_unit is None:
        found += _of_baseline(sample, camera.baseline_m, config.audit)
    findings = []
    for key, own in found:
        code = key.split()[0]  # what follows tells texts of one code apart
        text = _TEXTS[key].format(**own)
        findings.append(Finding(code, own.get("fatal", code in _FATAL), text))
    return sorted(findings, key=lambda finding: not finding.fatal)


def _of_images(sample: Sample, matcher: str | Matcher) -> Found:
    if sample.broken is not None:
        key = "size error" if "size" in sample.broken.what else "unreadable"
        yield key, {"error": sample.broken}
    for side in _blank_sides(sample):
        mean = np.median([one.brightness_dn[side] for one in sample.pairs])
        yield "black", {"side": _SIDES[side], "mean": mean}
    pairs = [one for one in sample.recorded if isinstance(one, StereoPair)]
    dark = {}
    for number, name in enumerate(_SIDES if pairs else ()):
        images = [getattr(pair, name) for pair in pairs]
        if np.median([measure_mosaic(image) for image in images]) > _MOSAIC:
            yield "mosaic", {"side": name}
        mean = float(np.median([image.mean() for image in images]))
        textured = np.mean([shows_texture(image) for image in images]) > 0.5
        if mean < _DARK_DN and not textured and number not in _blank_sides(sample):
            dark[name] = mean
    if dark:
        yield "dark", {"side": " and ".join(dark), "mean": min(dark.values())}
    if sample.sharpness is not None:
        left, right = sample.sharpness
        worse, better = min(left, right), max(left, right)
        if worse < _SHARPNESS_RATIO * better:
            yield "blur", {"side": _SIDES[int(right < left)], "worse": worse, "better": better}
        elif better < _SHARPNESS:
            yield "blur both", {"left": left, "right": right}
    gain, features = sample.gain
    if features >= MIN_FEATURES and not 1 / _GAIN < gain < _GAIN:
        evened = "; until then it is evened before matching" if matcher in EVENED else ""
        yield "gain", {"gain": gain, "other": evened}


def _blank_sides(sample: Sample) -> list[int]:
    """Return cameras whose images are uniform in most pairs."""
    blank = np.array([one.contrast_dn for one in sample.pairs]).reshape(-1, 2) < BLANK_DN
    return [side for side in range(2) if len(blank) and blank[:, side].mean() >= 0.5]


def _of_series(sample: Sample, gaps: Gaps) -> Found:
    repeats, blank = sample.repeats, _blank_sides(sample)
    if repeats.steps and repeats.both > _REPEATED_RATIO * repeats.steps:
        yield "duplicates", {"repeated": repeats.both, "steps": counted(repeats.steps, "frame")}
    for side, run in enumerate(repeats.frozen):
        # A camera with uniform images would count as frozen, too.
        if run >= _FROZEN_FRAMES and side not in blank:
            yield "frozen", {"side": _SIDES[side], "run": counted(run, "frame")}
    if gaps.count:
        yield "gaps", {"places": counted(gaps.count, "place"), "gaps": gaps}


def _of_geometry(look: Look) -> Found:
    geometry, skew = look.geometry, look.skew
    swapped, offset = geometry.swapped_ratio, geometry.offset
    if look.shifted:
        yield "lag shifted", {"fatal": False, "paired": look.first[0]}
    if swapped >= SWAPPED_RATIO:
        yield "swapped", {"percent": 100 * swapped}
    if offset:
        shift = look.source.shift_of(offset)
        in_step = f"--set source.shift_frames={shift} pairs the images that belong together"
        yield (
            "lag",
            {
                "late": "right" if offset > 0 else "left",
                "frames": counted(abs(offset), "frame"),
                "in_step": "pair the images by timestamp" if shift is None else in_step,
            },
        )
    elif skew is not None and abs(skew[0]) > max(MOST_TIME_OFFSET, 4 * skew[1]):
        yield "skew", {"skew": skew[0]}
    rows = geometry.alignment
    if offset:  # rows say nothing of the cameras then
        return
    if look.rig.not_rigid:
        yield "nonrigid", {"found": look.rig.not_rigid[0]}
    elif rows is None and geometry.pairs:
        yield "features", {"matched": geometry.matched}
    elif rows is not None and rows.rms_px > _EPIPOLAR_PX:
        pitch, _, roll, _ = np.degrees(rows.turn)
        corrected = look.rig.fitted is not None
        fatal = rows.rms_px > _BAD_EPIPOLAR_PX and not corrected
        who = "recon map does so, and " if corrected else ""
        yield "rows", {"fatal": fatal, "rows": rows, "pitch": pitch, "roll": roll, "who": who}


def _of_rig(rig: RefinedRig, disparity_px: Float64) -> Found:
    """Yield a rig with which depth is off where most of what it sees is."""
    if rig.fitted is not None and not rig.fitted.fixed:
        yield "stabilised", {"found": MOVES}
    if not rig.changes or not len(disparity_px):
        return
    middle_px = max(float(np.median(disparity_px)), 1.0)
    working_m = rig.camera.focal_px * rig.camera.baseline_m / middle_px
    if rig.wrong_at(working_m):
        yield "rig", {"shown": rig.describe(working_m)}


def _of_range(disparity_px: Float64, matching: MatchingSettings, camera: RectifiedCamera) -> Found:
    if len(disparity_px) < MIN_FEATURES:
        return
    adapts, reach_px = matching.ndisp is None and camera.ndisp is None, None
    if not adapts and "ndisp" in settings_taken(matching.matcher):
        reach_px = matching.min_disparity_px + matching.ndisp_for(camera)
    scale = camera.focal_px * camera.baseline_m
    # A matcher's disparity is in image columns, without doffs.
    columns_px = disparity_px - camera.doffs_px
    near = float(np.mean(columns_px > reach_px)) if reach_px else 0.0
    if reach_px and near > _NEAR_RATIO:
        reach = {"reach_px": reach_px, "reach": metres(scale / (reach_px + camera.doffs_px))}
        most = int(np.ceil(np.quantile(columns_px, 0.98) / 16) * 16)
        yield "near", {"percent": 100 * near, **reach, "most": most}
    middle = float(np.median(disparity_px))
    if 0 < middle < _FAR_PX:
        baseline = {"baseline_m": camera.baseline_m}
        yield "far", {"depth": metres(scale / middle), "middle": middle, **baseline}


def _of_calibration(rig: Rig) -> Found:
    for side, centre, size in _centres(rig):
        if np.abs(np.array(centre) / size - 0.5).max() > LARGEST_CENTRE_OFFSET:
            own = dict(zip(("x", "y", "width", "height"), (*centre, *size), strict=True))
            yield "size", {"side": side, **own}
            break


def _of_baseline(sample: Sample, baseline_m: float, settings: AuditSettings) -> Found:
    (shortest, longest), speed = settings.baseline_m, sample.speed_m_per_s
    usual = settings.baseline_m == AuditSettings().baseline_m
    if not shortest <= baseline_m <= longest or (usual and speed > _MAX_SPEED_M_PER_S):
        moving = f", with which the rig moves at {metres(speed)}/s" if speed > 0 else ""
        ends = {"low": float(f"{baseline_m / 2:.1g}"), "high": float(f"{2 * baseline_m:.1g}")}
        yield "baseline", {"baseline_m": baseline_m, "moving": moving, **ends}


def _centres(rig: Rig) -> list[tuple[str, tuple[float, float], tuple[int, int]]]:
    """Return name, principal point and image size of each camera."""
    if isinstance(rig, RectifiedCamera):
        return [("left", (rig.cx_px, rig.cy_px), (rig.width_px, rig.height_px))]
    return [
        (name, (float(c.matrix[0, 2]), float(c.matrix[1, 2])), (c.width_px, c.height_px))
        for name, c in zip(_SIDES, (rig.left, rig.right), strict=True)
    ]
