"""The pipeline behind `recon pair`: two images in; disparity, cloud and mesh out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from recon.commands.config import ReconConfig, dump_config
from recon.commands.empty_map import check_cloud
from recon.core.errors import MeshingError
from recon.core.geometry.triangulation import depth_from_disparity
from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    PointCloud,
    Reason,
    RectifiedCamera,
    RectifiedPair,
    StereoCalibration,
    StereoPair,
    TriangleMesh,
)
from recon.evaluation import evaluate_disparity
from recon.export.mesh import mesh_coverage, reconstruct_view
from recon.io.atomic import write_text
from recon.io.images.disparity_png import fitting_scale, write_disparity_png
from recon.io.images.image import write_image
from recon.io.images.pfm import write_pfm
from recon.io.models.mesh import check_mesh_formats, write_mesh
from recon.io.models.mlp import Photo, write_mlp
from recon.io.models.ply import write_ply
from recon.rig.audit import Finding
from recon.rig.audit.pair_checks import OnePair, check_coverage, check_found, find_pair_faults
from recon.run.directory import RunDirectory
from recon.run.machine import use_threads
from recon.run.record import fingerprint, write_record
from recon.run.stopwatch import Stopwatch
from recon.run.summary import cost, plain
from recon.stereo.frame import FrameReconstructor, ReconstructedFrame


@dataclass(frozen=True, eq=False)
class PairInput:
    """One pair with its calibration and ground truth.

    Attributes:
        pair: The images.
        calibration: Calibration of the two cameras.
        files: Files that the pair was read from.
        truth: True disparity of the rectified left view, or None.
        notes: What the camera was taken from, where there is no calibration file; for warnings.
        up_to_scale: True if the baseline is unknown and counts as 1 m.
    """

    pair: StereoPair
    calibration: RectifiedCamera | StereoCalibration
    files: tuple[Path, ...] = ()
    truth: DisparityTruth | None = None
    notes: tuple[str, ...] = ()
    up_to_scale: bool = False


@dataclass(frozen=True, eq=False)
class PairRun:
    """Results of a run, from which its report is made.

    Attributes:
        name: Display name of the pair.
        config: The configuration.
        pair: The rectified images.
        disparity: Their disparity.
        cloud: The points in camera axes, or None if only the disparity was requested.
        mesh: The surface in camera axes, or None.
        truth: True disparity, or None.
        metrics: Errors against it, or None.
        summary: The figures of ``summary.json``.
        warnings: Problems that did not stop the run.
    """

    name: str
    config: ReconConfig
    pair: RectifiedPair
    disparity: Disparity
    cloud: PointCloud | None
    mesh: TriangleMesh | None
    truth: DisparityTruth | None
    metrics: DisparityMetrics | None
    summary: dict[str, Any]
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        parts = (self.disparity, self.cloud, self.mesh)
        made = ", ".join(repr(part) for part in parts if part is not None)
        return f"PairRun({self.name!r}, {made}, {len(self.warnings)} warnings)"


@dataclass(frozen=True)
class PairOptions:
    """Options of a run that are not part of the configuration.

    Attributes:
        command: ``pair``, or ``disparity`` for the disparity alone.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores. Changes no result.
        formats: Suffixes of the mesh files besides PLY, without the dot.
        present: Writes figures and the report into the result folder.
        on_stage: Called with the name of each long stage when it begins.
    """

    command: str = "pair"
    out: Path | None = None
    threads: int | None = None
    present: Callable[[PairRun, RunDirectory], None] | None = None
    on_stage: Callable[[str], None] | None = None
    formats: tuple[str, ...] = ()

    def tell(self, stage: str) -> None:
        """Report that a stage begins."""
        if self.on_stage is not None:
            self.on_stage(stage)


def run_pair(given: PairInput, config: ReconConfig, options: PairOptions) -> PairRun:
    """Reconstruct one pair and write the results.

    ``pair`` writes disparity, depth, reasons, cloud, mesh and report; ``disparity`` writes
    disparity and reasons alone.

    Raises:
        ReconError: The pair cannot be matched, or the folder cannot be written; nothing is left
            behind.
    """
    start = time.perf_counter()
    check_mesh_formats(options.formats)
    threads, watch = use_threads(options.threads), Stopwatch()
    with RunDirectory.for_command(options.command, options.out) as directory:
        reconstructor = FrameReconstructor(
            given.calibration, config, threads=threads, stopwatch=watch
        )
        faults = _look(given, config, options, watch)
        options.tell("match")
        if options.command == "disparity":
            run = _match(given, config, reconstructor)
        else:
            run = _reconstruct(given, config, reconstructor, options, watch)
        few = check_found(run.disparity, given.pair, faults)
        if run.cloud is not None:
            camera = run.pair.camera
            check_cloud(len(run.cloud), run.disparity, camera, config.cloud, run.name)
        run = replace(
            run, warnings=(*given.notes, *(fault.text for fault in faults), *few, *run.warnings)
        )
        with watch.stage("write"):
            _write(run, directory, options.formats)
        run.summary.update(cost(watch, time.perf_counter() - start))
        if options.present is not None:
            options.tell("report")
            with watch.stage("report"):
                options.present(run, directory)
        run.summary["warnings"] = list(run.warnings)
        run.summary.update(cost(watch, time.perf_counter() - start))
        run.summary["out"] = str(directory.folder)
        directory.write_json("summary.json", run.summary)
        record = {
            "source": run.name,
            "inputs": fingerprint(given.files),
            "timings": watch.seconds,
            "peak_memory_mb": run.summary["peak_memory_mb"],
            "warnings": list(run.warnings),
        }
        write_record(directory, options.command, record)
    return run


def _look(
    given: PairInput, config: ReconConfig, options: PairOptions, watch: Stopwatch
) -> tuple[Finding, ...]:
    """Audit the images and their calibration before matching."""
    with watch.stage("audit"):
        one = OnePair(given.pair, given.calibration, given.files)
        return find_pair_faults(
            one, config, metric=options.command == "pair" and not given.up_to_scale
        )


def _match(given: PairInput, config: ReconConfig, reconstructor: FrameReconstructor) -> PairRun:
    """The results for ``disparity``: the disparity alone."""
    pair, disparity = reconstructor.match(given.pair)
    return replace(_run(given, config, pair, disparity), warnings=reconstructor.inspect(pair))


def _reconstruct(
    given: PairInput,
    config: ReconConfig,
    reconstructor: FrameReconstructor,
    options: PairOptions,
    watch: Stopwatch,
) -> PairRun:
    """The results for ``pair``; a failed mesh is only a warning."""
    frame = reconstructor.reconstruct(given.pair)
    options.tell("mesh")
    mesh: TriangleMesh | None = None
    coverage: float | None = None
    warnings = frame.warnings
    try:
        with watch.stage("mesh"):
            mesh = reconstruct_view(frame.cloud, frame.pair.camera, config.mesh)
            coverage = mesh_coverage(mesh, frame.cloud)
        warnings = (*warnings, *check_coverage(coverage))
    except MeshingError as error:
        warnings = (*warnings, f"no mesh: {error}")
    run = _run(given, config, frame.pair, frame.disparity)
    figures = _metric_summary(frame, mesh) | {"mesh_coverage": coverage}
    figures["up_to_scale"] = given.up_to_scale
    return replace(
        run, cloud=frame.cloud, mesh=mesh, summary=run.summary | figures, warnings=warnings
    )


def _run(
    given: PairInput, config: ReconConfig, pair: RectifiedPair, disparity: Disparity
) -> PairRun:
    """The results of matching, without cloud and mesh."""
    metrics = None if given.truth is None else evaluate_disparity(disparity, given.truth)
    summary = _summary(given.pair.name, disparity)
    if metrics is not None:
        summary["disparity"] = plain(metrics)
    return PairRun(
        name=given.pair.name,
        config=config,
        pair=pair,
        disparity=disparity,
        cloud=None,
        mesh=None,
        truth=given.truth,
        metrics=metrics,
        summary=summary,
        warnings=(),
    )


def _summary(name: str, disparity: Disparity) -> dict[str, Any]:
    found = disparity.values[disparity.valid]
    shares = np.bincount(disparity.reason.ravel(), minlength=len(Reason)) / disparity.reason.size
    return {
        "pair": name,
        "width_px": disparity.values.shape[1],
        "height_px": disparity.values.shape[0],
        "valid_percent": 100.0 * float(disparity.valid.mean()),
        "reasons_percent": {r.name.lower(): 100.0 * float(shares[r]) for r in Reason},
        "disparity_median_px": float(np.median(found)) if len(found) else None,
    }


def _metric_summary(frame: ReconstructedFrame, mesh: TriangleMesh | None) -> dict[str, Any]:
    camera, z = frame.pair.camera, frame.cloud.xyz[:, 2]
    return {
        "points": len(frame.cloud),
        "depth_median_m": float(np.median(z)) if len(z) else None,
        "faces": 0 if mesh is None else len(mesh.faces),
        "focal_px": camera.focal_px,
        "field_of_view_deg": camera.field_of_view_deg,
        "cx_px": camera.cx_px,
        "cy_px": camera.cy_px,
        "baseline_m": camera.baseline_m,
        "doffs_px": camera.doffs_px,
    }


def _write(run: PairRun, directory: RunDirectory, formats: tuple[str, ...]) -> None:
    path, disparity = directory.path, run.disparity
    write_pfm(path("disparity/disparity.pfm"), disparity.values)
    scale = fitting_scale(disparity.values)
    write_disparity_png(path("disparity/disparity.png"), disparity.values, scale=scale)
    write_pfm(path("disparity/confidence.pfm"), disparity.confidence)
    write_image(path("disparity/reason.png"), disparity.reason)
    write_text(path("config.yaml"), dump_config(run.config))
    run.summary["disparity_png_scale"] = scale
    if run.cloud is None:
        return
    depth_m = depth_from_disparity(disparity.values, run.pair.camera)
    write_pfm(path("disparity/depth.pfm"), depth_m)
    write_ply(path("clouds/cloud.ply"), run.cloud)
    if run.mesh is not None:
        for suffix in ("ply", *formats):
            write_mesh(path(f"mesh/mesh.{suffix}"), run.mesh, "camera")
        layers = {"mesh": path("mesh/mesh.ply"), "cloud": path("clouds/cloud.ply")}
        write_image(path("mesh/left.png"), run.pair.colours)
        photo = Photo(path("mesh/left.png"), run.pair.camera)
        write_mlp(path("mesh/mesh.mlp"), layers, "camera", photo)
