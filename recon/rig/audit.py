"""The audit of a recording, or of a pair: what is measured and found, the verdict, a correction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from recon.core.errors import CalibrationError, MatchingError
from recon.core.progress import stage
from recon.core.summary import Figures, Rows, RunSummary, hidden, inline, optional, shown_path
from recon.core.text import counted, length, metres, round_lengths
from recon.core.values import Disparity, Reason, RectifiedCamera, Rig
from recon.core.values.arrays import Float64
from recon.core.values.camera import depth_sigma
from recon.look.findings import Finding, Verdict, find_faults, verdict_of
from recon.look.look import Look, look_at
from recon.look.rig import RefinedRig, RigFigures
from recon.look.sample import QUICK, THOROUGH, PairMeasures
from recon.look.settings import AuditedSettings
from recon.rig.written import form_of, nearest_of_kalibr, write_rig
from recon.sources.one_pair import OnePair, PairInput
from recon.sources.source import StereoSource, check_source
from recon.stereo.frame import FrameReconstructor, StereoSettings
from recon.stereo.observe import Support
from recon.stereo.rectify.epipolar import EpipolarAlignment, correct_rig
from recon.stereo.rectify.rectifier import turns_of

# Findings of a pair that images alone support, and those that need a calibration. The inspection of
# the frame reports others.
_BY_IMAGES: Final = frozenset({"black", "mosaic", "gain", "blur", "features"})
_BY_CALIBRATION: Final = frozenset({"size", "baseline", "near", "far"})
# Fraction of pixels with a measured disparity below which a pair is warned of: real ones, even of
# bare walls, exceed 40 %. It is also warned of where more was inferred than measured.
_FEW_MEASURED_RATIO: Final = 0.25
# Findings with which epipolar errors and motion say nothing about the calibration.
_NOT_OF_THE_RIG: Final = frozenset(
    {"lag", "nonrigid", "stabilised", "swapped", "size", "frozen", "unreadable"}
)
_LEAST_DISPARITY_PX: Final = 1.0  # farther than that, depths of a table say nothing
_LEAST_SIGMA_PX: Final = 0.05  # no matcher is more accurate on real images


@dataclass(frozen=True)
class FindingFigures(Figures):
    """One fact about a recording that its user should know."""

    code: str  # its kind, one word, for programs
    severity: Literal["fatal", "warning"]
    text: str  # description and advice, for people


@dataclass(frozen=True, kw_only=True)
class AuditFigures(Figures):
    """What is measured of a recording; None = it is not known."""

    source: str
    description: str
    frames: int
    frames_left_out: int
    frames_read: int
    repeated_frames: int
    frozen_left_frames: int
    frozen_right_frames: int
    gaps: int
    longest_step_s: float
    usual_step_s: float
    gain: float  # brightness of the right images, relative to that of the left ones
    sharpness_left: float | None  # from 0 to 1
    sharpness_right: float | None
    features: int
    swapped_ratio: float  # fraction of near features that suggest swapped cameras
    time_offset_frames: int | None  # by how many frames the right camera is late
    time_skew_frames: float | None
    baseline_m: float
    focal_px: float
    field_of_view_deg: float
    speed_m_per_s: float
    epipolar_error_mean_px: float | None = optional()  # epipolar error of features
    epipolar_error_spread_px: float | None = optional()
    epipolar_error_rms_px: float | None = optional()
    epipolar_noise_px: float | None = optional()
    repair_pitch_deg: float | None = optional()  # rotation of the right camera that corrects it
    repair_roll_deg: float | None = optional()
    disparity_5_50_95_px: Sequence[float] | None = optional()
    depth_error_m: Mapping[str, float] | None = optional()  # standard deviation by distance
    rig_by_motion: RigFigures | None = optional()


@dataclass(frozen=True, kw_only=True)
class Correction(Figures):
    """How a corrected rig differs from its calibration."""

    epipolar_error_before_px: float
    pitch_deg: float  # of the right camera, as are the next
    yaw_deg: float = 0.0
    roll_deg: float
    focal_percent: float = 0.0
    disparity_rms_px: float | None = optional()  # over the image, where motion shows it
    lens_off_px: float | None = optional()  # of the nearest lens that the format knows


@dataclass(frozen=True, kw_only=True)
class CorrectedFigures(Figures):
    """A corrected rig that was written."""

    correction: Correction = inline()
    calibration: str
    files: Sequence[str]


@dataclass(frozen=True, kw_only=True)
class AuditSummary(RunSummary):
    """What `recon audit` found; its warnings are those of the source."""

    verdict: Verdict
    findings: Sequence[FindingFigures]
    figures: AuditFigures = inline()
    repaired: CorrectedFigures | None = optional()
    path: str = hidden("")  # of the recording, as it was named

    def remarks(self) -> list[tuple[str, str]]:
        return [*super().remarks(), *((one.severity, one.text) for one in self.findings)]

    def rows(self) -> Rows:
        found = self.figures
        frames = f"{counted(found.frames, 'frame')}, {found.frames_read} examined"
        repeated = f", {found.repeated_frames} repeated" if found.repeated_frames else ""
        rms_px, at = found.epipolar_error_rms_px, middle_depth(found.depth_error_m)
        depth = "" if at is None else f"± {length(at[1])} at {at[0]} m (standard deviation)"
        return [
            (f"{found.source} is {self.verdict}",),
            ("frames", frames + repeated),
            *([] if rms_px is None else [("epipolar", f"error of {rms_px:.2f} px (RMS)")]),
            *([("depth", depth)] if depth else []),
            ("rig", f"baseline {metres(found.baseline_m)}, focal length {found.focal_px:.0f} px"),
            *([] if self.repaired is None else [("repaired", ", ".join(self.repaired.files))]),
            *self.folder_row(),
            self._next(),
        ]

    def _next(self) -> tuple[str, str]:
        source = shown_path(self.path) if self.path else "SOURCE"
        if self.verdict == "not usable":
            return "next", "repair what is fatal above, or record again"
        if self.repaired is not None:
            return "next", f"recon map {source} --calib {shown_path(self.repaired.calibration)}"
        return "next", f"recon map {source}"


@dataclass(frozen=True, eq=False)
class Audit:
    """The result of an audit."""

    verdict: Verdict
    findings: tuple[Finding, ...]  # problems, fatal ones first
    figures: AuditFigures  # all measures
    notes: Sequence[str]  # what the source says of itself
    alignment: EpipolarAlignment | None  # of all pairs together; None = too few features
    rig: RefinedRig  # as given, and as the motion of the drive shows it
    pairs: tuple[PairMeasures, ...] = ()  # what was measured in each, and a few images
    corrected: CorrectedFigures | None = None  # what `correct_calibration` did, if it was asked to

    def __repr__(self) -> str:
        found = ", ".join(finding.code for finding in self.findings) or "no findings"
        return f"Audit({self.verdict!r}, {found})"

    @property
    def summary(self) -> AuditSummary:
        """What `recon audit` prints."""
        return AuditSummary(
            verdict=self.verdict,
            findings=[
                FindingFigures(one.code, "fatal" if one.fatal else "warning", one.text)
                for one in self.findings
            ],
            warnings=self.notes,
            figures=self.figures,
            repaired=self.corrected,
        )


def audit_source(source: StereoSource, config: AuditedSettings, *, quick: bool = False) -> Audit:
    """Check a drive before a long run; ``quick``: as much as `recon map` looks at."""
    check_source(source, stereo=True)
    stage("audit")
    look = look_at(source, config, extent=QUICK if quick else THOROUGH)
    findings = find_faults(look, config)
    verdict, seen = verdict_of(findings), tuple(look.sample.pairs)
    alignment, figures = look.geometry.alignment, _figures(look)
    notes = look.source.warnings()
    return Audit(verdict, tuple(findings), figures, notes, alignment, look.rig, seen)


def correct_calibration(
    source: StereoSource, config: AuditedSettings, audit: Audit, path: Path
) -> CorrectedFigures:
    """Write the calibration with which epipolar errors and motion agree, and return how it differs.

    It is the one that `recon map` uses; of a drive that is too short for it, rows alone are
    aligned. The baseline stays. The name of the file tells its format; kalibr gets the nearest
    lenses that it knows.

    Raises:
        CalibrationError: There are too few features, or what the recording shows is no fault of the
            calibration, such as images of different moments.
    """
    rig, rows = audit.rig, audit.alignment
    for finding in audit.findings:
        if finding.code in _NOT_OF_THE_RIG:
            what = "the recording does not show the rig: a calibration from it would be wrong"
            raise CalibrationError(what, where=source.name, got=finding.text)
    if rows is None:
        raise CalibrationError(
            "too few features to correct the calibration",
            where=source.name,
            hint="record scenes with more texture, or recalibrate the cameras",
        )
    own, R_left = rig.figures().motion, turns_of(source.calibration, config.rectification).R_left
    if own is None:
        corrected: Rig = correct_rig(source.calibration, rows.turn, R_left)
        pitch_deg, _, roll_deg, _ = np.degrees(rows.turn).tolist()
        found = Correction(
            epipolar_error_before_px=rows.rms_px, pitch_deg=pitch_deg, roll_deg=roll_deg
        )
    else:
        corrected = rig.calibration
        found = Correction(
            epipolar_error_before_px=rows.rms_px,
            pitch_deg=own.pitch_deg,
            yaw_deg=own.yaw_deg,
            roll_deg=own.roll_deg,
            focal_percent=own.focal_percent,
            disparity_rms_px=own.disparity_px.rms,
        )
    if form_of(path) == "kalibr":
        corrected, lens_off_px = nearest_of_kalibr(corrected)
        found = replace(found, lens_off_px=lens_off_px)
    files = write_rig(path, corrected, config.rectification, quality=found.to_json())
    names = [str(file) for file in files]
    return CorrectedFigures(correction=found, calibration=names[0], files=names)


def _figures(look: Look) -> AuditFigures:
    source, sample, gaps = look.source, look.sample, look.gaps
    geometry, camera, rig = look.geometry, look.camera, look.rig
    sharpness = [None, None] if sample.sharpness is None else sample.sharpness.tolist()
    found = AuditFigures(
        source=source.name,
        description=source.description,
        frames=len(source),
        frames_left_out=source.left_out,
        frames_read=sample.frames,
        repeated_frames=sample.repeats.both,
        frozen_left_frames=sample.repeats.frozen[0],
        frozen_right_frames=sample.repeats.frozen[1],
        gaps=gaps.count,
        longest_step_s=gaps.longest_s,
        usual_step_s=gaps.usual_s,
        gain=sample.gain[0],
        sharpness_left=sharpness[0],
        sharpness_right=sharpness[1],
        features=len(geometry.features),
        swapped_ratio=geometry.swapped_ratio,
        time_offset_frames=geometry.offset,
        time_skew_frames=None if look.skew is None else look.skew[0],
        baseline_m=camera.baseline_m,
        focal_px=camera.focal_px,
        field_of_view_deg=camera.field_of_view_deg,
        speed_m_per_s=sample.speed_m_per_s,
        rig_by_motion=rig.figures() if rig.fitted else None,
    )
    return _with_alignment(found, geometry.alignment, geometry.disparity_px, camera)


def _with_alignment(
    found: AuditFigures,
    alignment: EpipolarAlignment | None,
    disparity_px: Float64,
    camera: RectifiedCamera,
) -> AuditFigures:
    """Add epipolar errors, disparities, and the depth error if columns are as accurate as rows."""
    if alignment is None:
        return found
    pitch_deg, _, roll_deg, _ = np.degrees(alignment.turn).tolist()
    found = replace(
        found,
        epipolar_error_mean_px=alignment.mean_px,
        epipolar_error_spread_px=alignment.spread_px,
        epipolar_error_rms_px=alignment.rms_px,
        epipolar_noise_px=alignment.residual_px,
        repair_pitch_deg=pitch_deg,
        repair_roll_deg=roll_deg,
    )
    if not len(disparity_px):
        return found
    sigma_px = np.float32(max(alignment.residual_px, _LEAST_SIGMA_PX))
    spread_px = np.quantile(disparity_px, [0.05, 0.5, 0.95])
    found = replace(found, disparity_5_50_95_px=spread_px.tolist())
    if not spread_px[1] > 0.0:
        return found
    far_px, near_px = np.maximum(spread_px[[0, 2]], _LEAST_DISPARITY_PX)
    fb = camera.focal_px * camera.baseline_m
    depths_m = round_lengths(fb / near_px, fb / far_px)
    errors = depth_sigma(np.array(depths_m, np.float32), sigma_px, camera)
    by_depth = {f"{z:g}": float(e) for z, e in zip(depths_m, errors, strict=True)}
    return replace(found, depth_error_m=by_depth)


def middle_depth(error_m: Mapping[str, float] | None) -> tuple[str, float] | None:
    """Return the depth in the middle of those that a drive shows, and its error."""
    return [*error_m.items()][(len(error_m) - 1) // 2] if error_m else None


def check_related(look: Look, config: StereoSettings) -> None:
    """Refuse a drive if most of a few pairs do not show that left and right belong together."""
    source = look.source
    reconstructor = FrameReconstructor(source.calibration, config)
    seen = [(p.index, reconstructor.inspect(reconstructor.rectify(p))[1]) for p in look.recorded]
    judged = [(index, support) for index, support in seen if support is not None]
    # In most: of unrelated images some look alike by chance.
    unlike = [(index, support) for index, support in judged if not support.shown]
    if 2 * len(unlike) > len(judged):
        index, support = unlike[-1]
        support.check(f"{source.name}, frame {index}")


def find_pair_faults(
    given: PairInput, config: AuditedSettings, *, metric: bool
) -> tuple[Finding, ...]:
    """Return findings of a quick audit; those of the calibration only if depth is wanted."""
    pair = given.pair
    # One image given twice: rectified by two cameras it looks like a swapped pair.
    if np.array_equal(pair.left, pair.right) and np.ptp(pair.left):
        hint = "name the image of each camera"
        raise MatchingError("left and right are the same image", where=pair.name or None, hint=hint)
    codes = _BY_IMAGES | _BY_CALIBRATION if metric else _BY_IMAGES
    if not config.audit.quick:
        return ()
    try:
        look = look_at(OnePair(pair, given.calibration), config)
    except CalibrationError:  # it cannot rectify, which the run itself reports
        return ()
    return tuple(one for one in find_faults(look, config) if one.code in codes)


def check_found(
    disparity: Disparity, name: str, support: Support | None, faults: tuple[Finding, ...] = ()
) -> tuple[str, ...]:
    """Return the warnings of a matched pair: those of its faults, and of how little was measured.

    What was inferred counts for nothing. A pair without a match, or of unrelated images, is a
    `MatchingError`.
    """
    fatal = next((fault.text for fault in faults if fault.fatal), None)
    if support is not None and disparity.measured.any():
        support.check(name or None, fatal)
    # Few features do not matter where much else matches.
    doubtful = support is None or support.doubtful
    known = tuple(one.text for one in faults if one.code != "features" or doubtful)
    measured, inferred = (float(kind.mean()) for kind in (disparity.measured, disparity.inferred))
    if measured >= max(_FEW_MEASURED_RATIO, inferred):
        return known
    advice = (
        "check that both images show the same moment, that left and right are not swapped, that "
        "the calibration is theirs, and the range (--ndisp)"
    )
    if disparity.measured.any():
        if support is not None:  # which shows that the images belong together
            advice = f"plain or dark surfaces need more light, or texture; else {advice}"
        found = f"only {100 * measured:.2g} % of the pixels were measured ({_reasons(disparity)})"
        return (*known, f"{found}; {advice}")
    what, got = "no pixel has a match in the other image", _reasons(disparity)
    raise MatchingError(what, where=name or None, got=got, hint=fatal or advice)


def _reasons(disparity: Disparity) -> str:
    ratios = {r: 100 * ratio for r, ratio in disparity.reason_ratios.items() if r and ratio >= 0.01}
    names = {r: r.name.lower().replace("_", " ") for r in ratios}
    names[Reason.FILLED] = "inferred from planes around"
    return ", ".join(f"{ratio:.0f} % {names[r]}" for r, ratio in list(ratios.items())[:2])
