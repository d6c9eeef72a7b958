"""`recon map`: open the source, audit it, map it, make the products, compare, report."""

from __future__ import annotations

import errno
import math
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Final

from recon.commands.config import ReconConfig, load_config
from recon.commands.kernels import compile_kernels
from recon.commands.map_options import MapOptions
from recon.commands.map_pieces import begun_in_pieces, map_pieces, pieces_of
from recon.commands.map_summary import MapSummary, PriorFigures, UsualProducts
from recon.core.errors import (
    ClusterError,
    MemoryLimitError,
    OutputError,
    ReconError,
    SettingsError,
    SourceError,
)
from recon.core.plugins import name_of
from recon.core.text import counted
from recon.core.values import OccupancyGrid, PointCloud, TrajectoryMetrics, TriangleMesh
from recon.evaluation.map import DriveErrors, compare_with_truth
from recon.export.make import Products, make
from recon.export.product import ExportContext
from recon.export.trajectories import export_paths
from recon.io.cameras.calibration import write_recon_calibration
from recon.look.findings import Finding, find_faults
from recon.look.length import check_length, see_baseline
from recon.look.look import Look, look_at
from recon.look.rig import KnownRig, RefinedRig, rig_shown
from recon.map.drive.drive import Workspace
from recon.map.drive.drive_odometry import doubt_poses
from recon.map.drive.scale import SceneScale, measure_scene
from recon.map.drive.sequence import MappedSequence, break_warnings, check_map, map_sequence
from recon.map.fusion import fusion_range_m, nominal_error_m
from recon.map.map import Map
from recon.map.sessions.copying import keep_map
from recon.map.store.map_file import MAP_FILE
from recon.odometry.health import ExpectedDrift, expected_drift, health_warnings
from recon.odometry.prior import MotionPrior
from recon.odometry.registry import check_odometry
from recon.odometry.sfm import check_sfm
from recon.rig.audit import check_related
from recon.run.directory import STARTED, RunDirectory, state_folder
from recon.run.run import Run
from recon.sources.calibration import RIG_FILE
from recon.sources.source import StereoSource, check_source

# Findings that a run says anyway.
_SAID: Final = frozenset({"rig", "nonrigid", "stabilised", "lag"})


@dataclass(frozen=True, eq=False)
class MapResult:
    """The results of a run."""

    mapped: MappedSequence  # the drive: its map, and what it cost
    made: Products  # what is left in memory of what was made of the map
    errors: DriveErrors  # errors against the truth, as far as the source knows it
    summary: MapSummary

    @property
    def cloud(self) -> PointCloud:
        """Even sample of the fused cloud; all points of a small one. Frame ``map``."""
        return self.made.cloud

    @property
    def grid(self) -> OccupancyGrid:
        """The flat grid."""
        return self.made.grid

    @property
    def mesh(self) -> TriangleMesh | None:
        """The surface in map axes; None = not wanted, not possible, or too large for memory."""
        return self.made.mesh

    @property
    def metrics(self) -> TrajectoryMetrics | None:
        """Errors against the true path; None = it is not known."""
        return self.errors.path

    @property
    def warnings(self) -> tuple[str, ...]:
        """Problems that did not stop the run."""
        return tuple(self.summary.warnings)

    def __repr__(self) -> str:
        made = f"{self.mapped}, {self.grid}, {self.mesh}"
        name, warnings = self.summary.source, counted(len(self.warnings), "warning")
        return f"MapRun({name!r}, {made}, {warnings})"


def run_map(
    source: StereoSource, config: ReconConfig | None = None, options: MapOptions | None = None
) -> MapResult:
    """Map a drive: what `recon map` does.

    A quick audit says what is wrong with the recording. Frame by frame the drive becomes a map in
    the folder of the run, from which an interrupted run is resumed. Cloud, OctoMap, grid and mesh
    are made of the map, compared with the truth if the source knows it, and shown in a report.

    Args:
        source: The drive.
        config: The configuration; None = the defaults.
        options: Options of the run; None = the defaults.

    Raises:
        ReconError: The source cannot be read or registered; nothing is left behind. Or the folder
            cannot be written or the memory limit is exceeded; the run can then be resumed.
    """
    config, options = config or load_config(), options or MapOptions()
    check_source(source)
    check_odometry(config.odometry.method)
    if config.odometry.method == "sfm" and options.known_poses is None:
        refuse_with_sfm(source, options)
    compile_kernels("map", config.matching.matcher, config.matching.keyframe_matcher)
    with _begun(source, config, options) as (run, map_, seen, scene, config):
        found, findings, source = seen.rig, seen.findings, seen.drive
        if config.rig.refine:
            map_.session().set_rig(found)
        if options.known_poses is not None and found.refined:
            poses = found.poses(options.known_poses, config.rectification)
            options = replace(options, known_poses=poses)
        if options.workers is not None or begun_in_pieces(run):
            map_pieces(source, config, options, run, map_)
        with options.listening(run) as options:
            mapped = map_drive(source, config, options, run, map_)
        rig = _shown_live(mapped, source, config, run) if source.live else found
        with run.stage("cloud"):
            check_map(mapped, source.name, (*seen.look.first, *findings))
        context = ExportContext(map_, mapped.placed, config.mesh, threads=run.threads)
        made = make(context, run.content, options.products, run.watch)
        with run.stage("compare"):
            given = options.known_poses is not None
            true = found.true_path(source, config.rectification)
            errors = compare_with_truth(source, mapped, made.grid, true, poses_given=given)
        drift = expected_drift(mapped.trajectory, mapped.health, mapped.camera, rig.length_ratio)
        said = [*rig.warnings(findings), *_next_drive(source, config, rig)]
        doubts = [*said, *_warnings(source, mapped, drift), *options.listener.warnings()]
        breaks = break_warnings(mapped)
        first = [] if mapped.sfm is None else mapped.sfm.warnings()
        known = [*first, *breaks, *findings]
        warnings = [*seen.look.first, *known, *doubts, *made.warnings, *errors.warnings]
        summary = _summary(
            source,
            options,
            mapped,
            made,
            errors,
            drift=drift,
            rig=rig,
            depth_m=scene.depth_m,
            warnings=warnings,
        )
        with run.stage("write"):
            export_paths(map_.first, mapped.joined, made.T_base_camera, run.content)
            keep_map(map_, run.path(MAP_FILE))
            with Map.open(run.path(MAP_FILE)) as kept:
                summary = replace(summary, map_mb_per_km=kept.mb_per_km)
        with run.report(summary) as summary:
            # Its figures take long to load, and the drive is mapped without them.
            from recon.report.map_page import map_page  # noqa: PLC0415
            from recon.report.page import write_page  # noqa: PLC0415

            shown = summary.to_json()
            write_page(map_page(map_, made, errors, mapped.sample, rig, shown), run)
        config.memory.check("report")
        record = {
            "source_description": source.description,
            "T_map_world": mapped.T_map_world.tolist(),
            **pieces_of(run, map_),
        }
        summary = run.finish(summary, source=source.name, inputs=source.files, record=record)
    return MapResult(mapped, made, errors, summary)


def refuse_with_sfm(source: StereoSource, options: MapOptions) -> None:
    """Refuse what structure from motion cannot work with, before any work is done."""
    check_sfm(source)
    if options.prior is not None or options.workers is not None:
        what = "structure from motion takes all pairs at once, and no motion of other sensors"
        raise SettingsError(what, hint="drop --prior, --workers and --scheduler")


@contextmanager
def _begun(
    source: StereoSource, config: ReconConfig, options: MapOptions
) -> Iterator[tuple[Run, Map, Seen, SceneScale, ReconConfig]]:
    """Begin a run and its map, once it is known what a look at the drive shows.

    The settings are those of the map, in which lengths that are not set follow from the scene.
    """
    with options.run(config) as run, with_resume_hint(run, source):
        seen = look_first(source, config, options, run)
        scene = measure_scene(seen.look.recorded, seen.rig.calibration, config)
        fitted = seen.shifted(config).at_scale(scene.scale)
        run.write_config(fitted)
        with options.begin(run, seen.look.source, fitted) as map_:
            options.begun(run.folder)
            yield run, map_, seen, scene, fitted


@dataclass(frozen=True, eq=False)
class Seen:
    """What is known of a drive before it is mapped or localized."""

    look: Look
    rig: RefinedRig  # with the baseline that measured lengths show, if there are any
    findings: tuple[str, ...]  # what is wrong with the recording

    @property
    def drive(self) -> StereoSource:
        """The drive as it is to be read: with the rig to be used, its images in step."""
        return self.rig.applied(self.look.source)

    def shifted(self, config: ReconConfig) -> ReconConfig:
        """Return the settings by which the drive is read as it was looked at."""
        if not self.look.shifted:
            return config
        by = {"shift_frames": self.look.source.shift_of(0)}
        return config.model_copy(update={"source": config.source.model_copy(update=by)})


def look_first(
    source: StereoSource,
    config: ReconConfig,
    options: MapOptions,
    run: Run,
    known: KnownRig | None = None,
) -> Seen:
    """Look at a drive, and say what is wrong; the folder of the run gets its calibration.

    Raises:
        SourceError: One camera is late by whole frames, and the images cannot be paired otherwise:
            whatever is made of them is wrong.
    """
    guide = None if options.prior is None else MotionPrior(options.prior, config.odometry.prior)
    measured = config.source.length or guide
    if config.source.length is not None:
        check_length(source, config.source.length)
    with run.stage("look"):
        look = look_at(source, config, config.rig, known=known)
        if look.sample.broken is not None:
            raise look.sample.broken
        findings = _findings(look, config, options)
        options.warn((*look.first, *findings))
        rig = look.rig
        if rig.rigidity is not None and not rig.rigidity.frames:
            check_related(look, config)
        if measured is not None and source.stereo:
            seen = see_baseline(rig.applied(look.source), config, measured, rig.length_ratio)
            rig = rig if seen is None else rig.with_baseline(seen, config.rig)
        if rig.refined:
            write_recon_calibration(run.path(RIG_FILE), rig.calibration)
        return Seen(look, rig, findings)


def _findings(look: Look, config: ReconConfig, options: MapOptions) -> tuple[str, ...]:
    """Return what is wrong with a drive, but what is said of its rig."""
    source = look.source
    if not options.audit or source.live:
        return ()
    found = faults_of(look, config)
    for finding in found:
        if finding.code == "lag" and finding.fatal:
            what = "left and right images are of different moments"
            raise SourceError(what, where=source.name, got=finding.text)
    lines = tuple(as_line(one) for one in found if one.code not in _SAID)
    if options.known_poses is None:
        return lines
    return (*lines, *doubt_poses(options.known_poses, source, config))


def faults_of(look: Look, config: ReconConfig) -> list[Finding]:
    """Return what is wrong with a recording; nothing where that is not asked for."""
    return find_faults(look, config) if config.audit.quick and look.source.stereo else []


def as_line(finding: Finding) -> str:
    """Return a finding as a warning of a run."""
    return f"{finding.text} [quick audit]"


def _shown_live(
    mapped: MappedSequence, source: StereoSource, config: ReconConfig, run: Run
) -> RefinedRig:
    """Measure the rig of a drive that has arrived, for the next one: this one is mapped."""
    with run.stage("rig"):
        rig = rig_shown(mapped.tracks, source.calibration, config.rectification)
    if config.rig.refine:
        mapped.session.set_rig(rig)
        if rig.refined:
            write_recon_calibration(run.path(RIG_FILE), rig.calibration)
    return replace(rig, calibration=source.calibration)


def _next_drive(source: StereoSource, config: ReconConfig, rig: RefinedRig) -> list[str]:
    """Return what to do about a rig that the drive was mapped with, and showed to be wrong."""
    if not (source.live and config.rig.refine and rig.wrong):
        return []
    return [f"{RIG_FILE} is the rig that this drive showed: the next one takes it with --calib"]


def map_drive(
    source: StereoSource, config: ReconConfig, options: MapOptions, run: Run, map_: Map
) -> MappedSequence:
    """Map what is left of a drive, into the map of a run."""
    return map_sequence(
        source,
        config,
        known_poses=options.known_poses,
        prior=options.prior,
        workspace=Workspace(map_, run.watch, run.threads, options.listener),
    )


def _warnings(
    source: StereoSource, mapped: MappedSequence, drift: ExpectedDrift | None
) -> list[str]:
    return [
        *source.warnings(),
        *health_warnings(mapped.health),
        *(() if drift is None else drift.warnings()),
        *(() if mapped.prior is None else mapped.prior.warnings()),
        *(() if mapped.imu is None else mapped.imu.lines),
        *mapped.doubts,
        *(() if mapped.loops is None else mapped.loops.warnings()),
    ]


def _summary(
    source: StereoSource,
    options: MapOptions,
    mapped: MappedSequence,
    made: Products,
    errors: DriveErrors,
    *,
    drift: ExpectedDrift | None,
    rig: RefinedRig,
    depth_m: float | None,
    warnings: list[str],
) -> MapSummary:
    frames, prior, given = len(mapped.trajectory), mapped.prior, options.known_poses is not None
    reach_m = fusion_range_m(mapped.camera, mapped.config.fusion)
    reach_m = min(reach_m, mapped.config.cloud.max_range_m or math.inf)
    return MapSummary(
        odometry="known poses" if given else name_of(mapped.config.odometry.method),
        source=source.name,
        frames=frames,
        fps=frames / mapped.seconds if mapped.seconds > 0 else None,
        frames_joined=int(mapped.joined.sum()),
        segments=mapped.segments,
        path_length_m=mapped.trajectory.select(mapped.joined).path_length_m,
        expected_drift_percent=None if drift is None else drift.percent,
        expected_drift_rig_percent=None if drift is None else drift.rig_percent,
        frames_not_trusted=int((~mapped.trusted).sum()),
        focal_px=mapped.camera.focal_px,
        field_of_view_deg=mapped.camera.field_of_view_deg,
        T_map_world=mapped.T_map_world,
        scale=mapped.config.scale,
        voxel_m=mapped.config.fusion.voxel_m,
        largest_voxel_m=mapped.config.fusion.largest_voxel_m,
        reach_m=reach_m,
        reach_error_m=nominal_error_m(reach_m, mapped.camera),
        typical_depth_m=depth_m,
        date=mapped.session.date.text,
        date_from=mapped.session.date.known_from,
        map_mb_per_km=None,  # the file is written when all else is done
        made=UsualProducts.of(made),
        rig=rig.figures(),
        loops=None if mapped.loops is None else mapped.loops.figures(),
        imu=None if mapped.imu is None else mapped.imu.figures(),
        base_frame=None if (mount := mapped.session.mount) is None else mount.base,
        sfm=None if mapped.sfm is None else mapped.sfm.figures(),
        trajectory=errors.path,
        map=errors.surface,
        occupancy=errors.occupancy,
        read=source.figures(),
        prior=None if prior is None else PriorFigures(origin=options.prior_origin, use=prior),
        warnings=warnings,
    )


@contextmanager
def with_resume_hint(run: RunDirectory, source: StereoSource) -> Iterator[None]:
    """Add a hint on how to resume to errors after which the run can be resumed.

    Of a live source, whose drive is over then, it says where the map is that was made so far.
    """
    try:
        yield
    except (KeyboardInterrupt, MemoryError, OSError, ReconError) as error:
        way_on = f"recon map --resume {shlex.quote(str(run.folder))} goes on from there"
        left = f"the map so far is in {state_folder(run.folder) / STARTED}"
        hinted = _with_hint(error, left if source.live else way_on) if run.begun else None
        if hinted is None:
            raise
        raise hinted from error


def _with_hint(error: BaseException, hint: str) -> BaseException | None:
    match error:
        case KeyboardInterrupt():
            return KeyboardInterrupt(hint)
        case OutputError() | ClusterError():
            return error.copy_with(hint=hint)
        case MemoryLimitError():
            return error.copy_with(hint=f"{hint} with a larger --memory-limit")
        case MemoryError():
            return MemoryLimitError("out of memory", hint=f"{hint}; give it a --memory-limit")
        case OSError(errno=errno.ENOSPC | errno.EDQUOT | errno.EFBIG, strerror=why):
            return OutputError("the disk is full", where=error.filename, got=why, hint=hint)
    return None
