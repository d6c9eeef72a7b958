"""`recon map`: open the source, audit it, map it, make the products, compare, report."""

from __future__ import annotations

from typing import Any

from recon.commands.config import ReconConfig, load_config
from recon.commands.map_options import MapOptions, begin_or_resume, identity_of, with_resume_hint
from recon.commands.map_pieces import begun_in_pieces, map_in_pieces, pieces_of
from recon.core.text import counted
from recon.evaluation.drive_errors import compare_with_truth
from recon.export.make import make
from recon.export.map_run import MapRun
from recon.export.product import Order
from recon.export.trajectories import export_paths
from recon.map.drive.drive_odometry import doubt_poses
from recon.map.drive.sequence import MappedSequence, check_map, map_sequence
from recon.map.drive.workspace import Workspace
from recon.map.store.finished import keep_map
from recon.map.store.map_file import MAP_FILE
from recon.map.verbs import Map
from recon.odometry.health import health_warnings
from recon.report.map_page import write_map_page
from recon.rig.audit.audit import quick_warnings
from recon.run.run import Run, plain
from recon.sources.live import LiveSource
from recon.sources.source import IncompleteSource, StereoSource


def run_map(
    source: StereoSource,
    config: ReconConfig | None = None,
    options: MapOptions | None = None,
) -> MapRun:
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
    findings = quick_warnings(source, config) if options.audit else ()
    if options.audit and options.known_poses is not None:
        findings += doubt_poses(options.known_poses, source, config)
    options.tell(findings)
    identity = identity_of(source, config, options.known_poses, options.prior)
    with (
        options.run(config) as run,
        with_resume_hint(run, source),
        begin_or_resume(run, source, config, identity, options.arguments) as map_,
    ):
        apart = options.workers is not None or begun_in_pieces(run)
        mapped = (map_in_pieces if apart else map_whole)(source, config, options, run, map_)
        with run.stage("cloud"):
            check_map(mapped, source.name, findings)
        made = make(Order(map_, mapped.placed, run, config.mesh), options.products)
        with run.stage("compare"):
            given = options.known_poses is not None
            errors = compare_with_truth(source, mapped, made.grid, poses_given=given)
        result = MapRun(
            name=source.name,
            config=config,
            mapped=mapped,
            made=made,
            truth=source.truth,
            metrics=errors.path,
            map_metrics=errors.surface,
            occupancy_metrics=errors.occupancy,
            warnings=(*findings, *_warnings(source, mapped), *made.warnings, *errors.warnings),
        )
        result.summary.update(_summary(source, result, options))
        with run.stage("write"):
            export_paths(mapped, made.camera_height_m, run)
            keep_map(map_, run.path(MAP_FILE))
        with run.report(result.summary):
            write_map_page(result, run)
        config.memory.check("report")
        record = {
            "source_description": source.description,
            "T_map_world": mapped.T_map_world.tolist(),
            **pieces_of(run, map_),
        }
        run.finish(result.summary, source=source.name, inputs=source.files, record=record)
    return result


def map_whole(
    source: StereoSource, config: ReconConfig, options: MapOptions, run: Run, map_: Map
) -> MappedSequence:
    """Map a drive in one piece, in this process, into the map of a run."""
    return map_sequence(
        source,
        config,
        known_poses=options.known_poses,
        prior=options.prior,
        progress=options.progress,
        workspace=Workspace(map_, run.watch, run.threads),
    )


def _warnings(source: StereoSource, mapped: MappedSequence) -> list[str]:
    """Return what the user should know about the drive."""
    left_out = source.left_out if isinstance(source, IncompleteSource) else 0
    return [
        *([f"{counted(left_out, 'image')} without a partner: left out"] if left_out else ()),
        *health_warnings(mapped.health),
        *(() if mapped.expected_drift is None else mapped.expected_drift.warnings()),
        *(() if mapped.prior is None else mapped.prior.warnings()),
        *(() if mapped.loops is None else mapped.loops.warnings()),
        *(source.warnings() if isinstance(source, LiveSource) else ()),
    ]


def _summary(source: StereoSource, result: MapRun, options: MapOptions) -> dict[str, Any]:
    given, prior = options.known_poses is not None, result.mapped.prior
    return {
        "odometry": "known poses" if given else result.config.odometry.method,
        **result.figures(),
        **({"frames_left_out": source.left_out} if isinstance(source, IncompleteSource) else {}),
        **({"live": source.figures()} if isinstance(source, LiveSource) else {}),
        **({} if prior is None else {"prior": {"from": options.prior_origin, **plain(prior)}}),
    }
