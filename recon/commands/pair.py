"""`recon pair` and `recon disparity`: two images in; disparity, cloud, mesh and report out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from typing_extensions import Self

from recon.commands.config import PAIR_DEFAULTS, ReconConfig, load_config
from recon.commands.kernels import compile_kernels
from recon.core.errors import SettingsError
from recon.core.plugins import name_of
from recon.core.progress import stage
from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    Reason,
    Rectified,
    Rig,
    StereoPair,
)
from recon.core.values.arrays import UInt8
from recon.evaluation.disparity import Kind, evaluate_disparity, evaluate_kinds
from recon.evaluation.pair_summary import (
    DisparityAccuracy,
    DisparityFigures,
    DisparitySummary,
    PairCloud,
    PairSummary,
)
from recon.export.pair import mesh_frame, write_cloud_files, write_disparity_files
from recon.io.cameras.calibration import read_calibration
from recon.io.files import StrPath, naming
from recon.io.middlebury import stand_in_camera
from recon.io.models.mesh import check_mesh_formats
from recon.map.drive.sequence import check_cloud
from recon.report.pair_page import PairResult, write_disparity_images, write_pair_page
from recon.rig.audit import check_found, find_pair_faults
from recon.run.run import Run
from recon.sources.one_pair import PairInput
from recon.stereo.frame import FrameReconstructor, ReconstructedFrame
from recon.stereo.match.onnx import describe_network
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.registry import (
    MATCHERS,
    MatchingSettings,
    check_matcher,
    field_of,
    plugin_groups,
    settings_taken,
)
from recon.stereo.match.search import SearchSettings


def run_pair(
    given: PairInput,
    config: ReconConfig | None = None,
    *,
    out: StrPath | None = None,
    formats: Sequence[str] = (),
    threads: int | None = None,
) -> PairResult:
    """Reconstruct one pair: what `recon pair` does.

    The images are checked as `recon audit` checks a recording, rectified and matched. The points
    that their disparity gives are filtered, and meshed as the camera saw them; without a mesh the
    run goes on. Disparity, depth, reasons, cloud, mesh and a report go to the result folder. Cloud
    and mesh have what was measured; with ``cloud.inferred``, what planes around a pixel say, too.

    Args:
        given: The images, their calibration and ground truth.
        config: The configuration; None = the defaults of `recon pair`.
        out: Result folder; None = a new one below ``outputs/``.
        formats: Suffixes of the mesh files besides PLY, without the dot.
        threads: Threads to use; None = all cores. Changes no result.

    Raises:
        ReconError: The pair cannot be matched, or the folder not be written; nothing is left.
    """
    config = config or load_config(defaults=PAIR_DEFAULTS)
    check_mesh_formats(formats)
    with Run("pair", out, config, threads=threads) as run:
        reconstructor = _reconstructor(given, config, run)
        with run.stage("audit"):
            faults = find_pair_faults(given, config, metric=not given.up_to_scale)
        stage("match")
        frame = reconstructor.reconstruct(given.pair)
        found = check_found(frame.disparity, given.pair.name, frame.support, faults)
        check_cloud(frame, config.cloud, given.pair.name)
        with run.stage("mesh"):
            mesh, coverage, unmeshed = mesh_frame(frame, config.mesh)
        with run.stage("write"):
            scale = write_disparity_files(frame.disparity, run.content, frame.pair.camera)
            write_cloud_files(frame, mesh, formats, run.content)
        warnings = [*given.notes, *found, *frame.warnings, *unmeshed, *_idle(config.matching)]
        errors = _Errors.of(frame.disparity, given.truth)
        summary = PairSummary(
            disparity=_figures(given.pair.name, frame.disparity, errors, config, scale),
            cloud=_cloud_figures(frame),
            faces=0 if mesh is None else len(mesh.faces),
            mesh_coverage=coverage,
            up_to_scale=given.up_to_scale,
            warnings=warnings,
        )
        result = _result(given, config, (frame.pair, frame.disparity), errors, summary)
        result = replace(result, cloud=frame.cloud, mesh=mesh)
        with run.report(summary) as summary:
            write_pair_page(replace(result, summary=summary), run)
        summary = run.finish(summary, source=result.name, inputs=given.files)
    return replace(result, summary=summary)


def run_disparity(
    given: PairInput,
    config: ReconConfig | None = None,
    *,
    out: StrPath | None = None,
    threads: int | None = None,
) -> PairResult:
    """Match one pair, and write disparity and reasons alone: what `recon disparity` does.

    The arguments and errors are those of `run_pair`.
    """
    config = config or load_config(defaults=PAIR_DEFAULTS)
    with Run("disparity", out, config, threads=threads) as run:
        reconstructor = _reconstructor(given, config, run)
        with run.stage("audit"):
            faults = find_pair_faults(given, config, metric=False)
        stage("match")
        pair, disparity = reconstructor.match(given.pair)
        inspected, support = reconstructor.inspect(pair)
        found = check_found(disparity, given.pair.name, support, faults)
        with run.stage("write"):
            scale = write_disparity_files(disparity, run.content)
        errors = _Errors.of(disparity, given.truth)
        summary = DisparitySummary(
            disparity=_figures(given.pair.name, disparity, errors, config, scale),
            warnings=[*given.notes, *found, *inspected, *_idle(config.matching)],
        )
        result = _result(given, config, (pair, disparity), errors, summary)
        with run.report(summary) as summary:
            write_disparity_images(result, run)
        summary = run.finish(summary, source=result.name, inputs=given.files)
    return replace(result, summary=summary)


@dataclass(frozen=True)
class _Errors:
    """Errors against the truth: of all pixels, and of measured and inferred ones alone."""

    every: DisparityMetrics
    by_kind: Mapping[Kind, DisparityMetrics]

    @classmethod
    def of(cls, disparity: Disparity, truth: DisparityTruth | None) -> Self | None:
        """Return the errors; None = the truth is not known."""
        if truth is None:
            return None
        return cls(evaluate_disparity(disparity, truth), evaluate_kinds(disparity, truth))


def _result(
    given: PairInput,
    config: ReconConfig,
    matched: tuple[Rectified, Disparity],
    errors: _Errors | None,
    summary: DisparitySummary | PairSummary,
) -> PairResult:
    return PairResult(
        given.pair.name,
        config,
        *matched,
        summary,
        truth=given.truth,
        metrics=None if errors is None else errors.every,
        by_kind={} if errors is None else errors.by_kind,
        warnings=tuple(summary.warnings),
    )


def _reconstructor(given: PairInput, config: ReconConfig, run: Run) -> FrameReconstructor:
    rig, watch = given.calibration, run.watch
    compile_kernels(config.matching.matcher)
    with naming(given.files[2]) if len(given.files) > 2 else nullcontext():  # the calibration
        return FrameReconstructor(rig, config, threads=run.threads, stopwatch=watch)


Calibration = Rig | StrPath


def match(
    left: UInt8,
    right: UInt8,
    calibration: Calibration | None = None,
    *,
    matcher: str | Matcher = "sad",
    **settings: Any,
) -> Disparity:
    """Match two images: return their disparity.

    It has what was measured, and what planes around a pixel say where nothing was found, or nothing
    sure: ``.measured`` and ``.inferred`` tell them apart, ``.only_measured()`` has the first alone,
    as has ``fill=False`` of `sad`, `sgm` and `fine`.

    Args:
        left: uint8 (H, W) grey or (H, W, 3) RGB.
        right: The same shape as ``left``.
        calibration: Needed if the images are not rectified; it also gives the disparity range.
            A value, or a file that `read_calibration` understands.
        matcher: Name of the matcher, one of recon's or one that an installed package registers;
            or any object with the methods of `Matcher`.
        **settings: Settings of the matcher, such as ``ndisp=64`` or ``window_px=9``; of a plug-in,
            those that it brings.

    Raises:
        ShapeError: The images differ in size.
        SettingsError: There is no such matcher, or a setting is unknown or out of its range.
        MatchingError: A matcher that is not recon's fails, or returns no disparity of the pair.
    """
    own = _own_settings(matcher, settings)
    config = load_config(None, [own], PAIR_DEFAULTS).with_matcher(matcher)
    pair = StereoPair(left, right)
    height_px, width_px = pair.left.shape[:2]
    camera = stand_in_camera(width_px, height_px) if calibration is None else calibration
    return FrameReconstructor(_rig_of(camera, pair), config).match(pair)[1]


def reconstruct(
    left: UInt8,
    right: UInt8,
    calibration: Calibration,
    config: ReconConfig | None = None,
    *,
    matcher: str | Matcher | None = None,
) -> ReconstructedFrame:
    """Reconstruct two images: rectified pair, disparity and cloud (camera axes, metres).

    The disparity is as `match` gives it; the cloud has what was measured alone, unless the settings
    ask for what was inferred (``cloud.inferred``), which its attribute ``inferred`` marks then.

    Args:
        left: uint8 (H, W) grey or (H, W, 3) RGB.
        right: The same shape as ``left``.
        calibration: Of the two cameras: a value, or a file that `read_calibration` understands.
        config: Settings of the stages; None = those of ``recon pair``.
        matcher: As for `match`; None = that of the settings.

    Raises:
        ReconError: The images, the calibration and the settings do not fit together, or nothing
            supports that the images do.
    """
    settings = (config or load_config(defaults=PAIR_DEFAULTS)).with_matcher(matcher)
    pair = StereoPair(left, right)
    frame = FrameReconstructor(_rig_of(calibration, pair), settings).reconstruct(pair)
    if frame.support is not None and frame.disparity.measured.any():
        frame.support.check(None)
    return frame


def _rig_of(calibration: Calibration, pair: StereoPair) -> Rig:
    if isinstance(calibration, Rig):
        return calibration
    height_px, width_px = pair.left.shape[:2]
    return read_calibration(calibration, width_px, height_px)


def _own_settings(matcher: str | Matcher, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a matcher by their dotted names; those that it does not have fail."""
    if not settings:
        return {}
    check_matcher(matcher)
    taken, group = settings_taken(matcher), field_of(name_of(matcher))
    if isinstance(matcher, str) and (matcher in MATCHERS or group in plugin_groups([matcher])):
        shared = taken & {*SearchSettings.model_fields}
        return {f"matching.{'' if n in shared else f'{group}.'}{n}": v for n, v in settings.items()}
    where, hint = f"matcher {name_of(matcher)!r}", "make the object with them"
    what = "this matcher takes no settings here"
    raise SettingsError(what, where=where, got=", ".join(settings), hint=hint)


def _figures(
    name: str,
    disparity: Disparity,
    errors: _Errors | None,
    config: ReconConfig,
    png_scale: float | None,
) -> DisparityFigures:
    found = disparity.values[disparity.measured]
    ratios, inferred = disparity.reason_ratios, 100.0 * float(disparity.inferred.mean())
    matching, accuracy = config.matching, None
    if errors is not None:
        kinds = (errors.by_kind.get("measured"), errors.by_kind.get("inferred"))
        accuracy = DisparityAccuracy(errors.every, *kinds)
    return DisparityFigures(
        pair=name,
        width_px=disparity.values.shape[1],
        height_px=disparity.values.shape[0],
        valid_percent=100.0 * float(disparity.measured.mean()),
        inferred_percent=inferred,
        filled_percent=inferred,
        reasons_percent={r.name.lower(): 100.0 * ratios.get(r, 0.0) for r in Reason},
        disparity_median_px=float(np.median(found)) if len(found) else None,
        accuracy=accuracy,
        network=describe_network(matching.onnx) if matching.matcher == "onnx" else None,
        disparity_png_scale=png_scale,
    )


def _idle(matching: MatchingSettings) -> tuple[str, ...]:
    """Return warnings of settings that were changed and that the matcher does not have."""
    # The range is searched by what supports the pair, too, whatever matches it.
    used = {"matcher", "keyframe_matcher", "fill", "ndisp", "min_disparity_px"}
    taken = settings_taken(matching.matcher) | used
    usual = type(matching)()
    idle = [
        name
        for name in type(matching).model_fields
        if name not in taken and getattr(matching, name) != getattr(usual, name)
    ]
    advice = f"the matcher is {name_of(matching.matcher)} (--matcher chooses another)"
    return tuple(f"matching.{one} has no effect: {advice}" for one in idle)


def _cloud_figures(frame: ReconstructedFrame) -> PairCloud:
    camera, z = frame.pair.camera, frame.cloud.only_measured().xyz[:, 2]
    inferred = frame.cloud.inferred
    return PairCloud(
        points=len(frame.cloud),
        inferred_points=None if inferred is None else int(inferred.sum()),
        depth_median_m=float(np.median(z)) if len(z) else None,
        focal_px=camera.focal_px,
        field_of_view_deg=camera.field_of_view_deg,
        cx_px=camera.cx_px,
        cy_px=camera.cy_px,
        baseline_m=camera.baseline_m,
        doffs_px=camera.doffs_px,
    )
