"""`recon export`, `occupancy` and `mesh`: products of a finished run, other settings or formats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from shutil import copyfile
from typing import Any, Final

from recon.commands.config import (
    REMADE,
    Changes,
    ReconConfig,
    check_changes,
    load_config,
    run_settings,
)
from recon.commands.map_summary import CloudSummary, ExportSummary
from recon.core.errors import FormatError, SettingsError
from recon.core.machine import available_cores
from recon.export.accuracy import measure_accuracy
from recon.export.control import locate
from recon.export.make import PRODUCTS, check_target, known_products, make, need_rays, write_product
from recon.export.mesh.pieces import LAYER, WHOLE
from recon.export.pair import PAIR_CLOUD, check_coverage, mesh_cloud, write_surface
from recon.export.product import ExportContext, ExportResult, open_images
from recon.io.atomic import atomic_path
from recon.io.files import StrPath, naming, reading, resolved
from recon.io.models.las import check_crs
from recon.io.models.mesh import check_mesh_formats
from recon.io.models.ply import read_ply, write_ply
from recon.map.drive.sequence import MappedSequence
from recon.map.map import Map
from recon.map.sessions.measured import Survey
from recon.map.sessions.placed import PlacedMap, place_map, place_map_on
from recon.map.store.map_file import MAP_FILE
from recon.report.accuracy_page import write_accuracy_page
from recon.run.batch.cluster import BatchOptions
from recon.run.finished import (
    DOUBTS,
    MAPPED_BY,
    camera_of_pair,
    command_of_map,
    is_pair_run,
    refuse_as_target,
)
from recon.run.run import Run

_GSD_M: Final = (1e-4, 10.0)


def run_export(
    source: StrPath,
    config: ReconConfig | None = None,
    *,
    products: Sequence[str] = (),
    formats: Sequence[str] = ("ply",),
    out: StrPath | None = None,
    threads: int | None = None,
    workers: BatchOptions | None = None,
    survey: Survey | None = None,
    images: Sequence[Path] = (),
    gsd_m: float | None = None,
    command: str = "export",
) -> ExportSummary | CloudSummary:
    """Make products of a finished run, and write them: what `recon export` does.

    Args:
        source: Folder of a run of map, demo, live, merge or pair.
        config: Its settings with changes, such as ``load_config(f"{source}/config.yaml",
            ["grid.max_height_m=3"])``; None = its own.
        products: Which of `PRODUCTS`; empty = those of `USUAL` that such a run can give.
        formats: Formats of the mesh, such as ``("ply", "glb")``.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores.
        workers: Where the tiles of the map are made; None = here. Changes no product.
        survey: Measured positions in whose coordinates products of surveys are written; None = in
            those of the map.
        images: Where drives are now whose images are needed, if not where they were mapped.
        gsd_m: Edge of a cell of the orthophoto, metres; None = as large as a pixel on the ground.
        command: Command name, for the record and the default folder.

    Raises:
        ReconError: There is no such product, the run is damaged or lacks what a product is made
            from, a setting has no effect, or the folder cannot be written; nothing is left behind.
    """
    source = Path(source)
    check_mesh_formats(formats)
    pair = is_pair_run(source)
    wanted = known_products(products, pair=pair)
    refuse_as_target(source, out)
    surveyed = [name for name, one in PRODUCTS.items() if one.surveyed]
    if survey is not None and not set(wanted) & set(surveyed):
        what, expected = "no product has the coordinates of the survey", " or ".join(surveyed)
        raise SettingsError(what, where="--to", got=", ".join(wanted), expected=expected)
    if survey is not None and survey.crs is not None:
        check_crs(survey.crs)
    if workers is not None and not need_rays(wanted):
        what = "only grids and OctoMaps are made on workers"
        hint = "drop --workers and --scheduler; a mesh uses --threads"
        raise SettingsError(what, got=", ".join(wanted), hint=hint)
    if gsd_m is not None and not ("orthophoto" in wanted and _GSD_M[0] <= gsd_m <= _GSD_M[1]):
        expected = "{:g} to {:g} m, for --to orthophoto".format(*_GSD_M)
        raise SettingsError(
            "not a cell of an orthophoto", where="--gsd", got=gsd_m, expected=expected
        )
    mapped_by = None if pair else command_of_map(source)
    ran = run_settings(source)
    settings = config or ran
    if mapped_by is None:
        with Run(command, out, settings, threads=threads) as run:
            return _of_cloud(source, run, settings, formats, wanted, of_run=str(source))
    check_changes(ran, settings, (*(REMADE if need_rays(wanted) else ()), "mesh"))
    with Map.open(source) as map_, Run(command, out, settings, threads=threads) as run:
        if any(PRODUCTS[name].needs_images for name in wanted):
            open_images(map_, images)
        with run.stage("map"):
            placed = _placed(map_, settings, run, workers)
        there = None
        if survey is not None:
            with run.stage("survey"):
                there = locate(map_, survey, images, run.threads)
        context = ExportContext(
            map_, placed, settings.mesh, formats, run.threads, there, images, gsd_m
        )
        made = make(context, run.content, wanted, run.watch)
        if there is not None and survey is not None:
            with run.stage("accuracy"):
                files = {
                    "products": {name: run.path(name) for name in run.files()},
                    "inputs": {str(MAP_FILE): source / MAP_FILE, **survey.files},
                }
                accuracy, places = measure_accuracy(context, there, files)
                run.write_json("accuracy.json", accuracy.to_json())
                write_accuracy_page(accuracy, places, run)
        doubts, T_map_world = map_.doubts, map_.first.T_map_world
        summary = ExportSummary(
            run=str(source),
            frames=len(placed.path_m),
            survey=None if there is None else there.figures(),
            products=made.figures,
            T_map_world=T_map_world,
            warnings=[*doubts, *(() if there is None else there.warnings()), *made.warnings],
        )
        record = {MAPPED_BY: mapped_by, "T_map_world": T_map_world.tolist(), DOUBTS: doubts}
        return run.finish(summary, source=str(source), inputs=[source / MAP_FILE], record=record)


def _placed(map_: Map, settings: ReconConfig, run: Run, workers: BatchOptions | None) -> PlacedMap:
    if workers is None:
        return place_map(map_, settings, run.threads)
    with workers.connect() as cluster:
        folder = resolved(run.state("tiles"))
        return place_map_on(map_, settings, folder, cluster.each, cluster.at_once)


def export_map(
    map_: Map | MappedSequence,
    product: str,
    path: StrPath,
    changes: Changes | Mapping[str, Any] = (),
    *,
    images: Sequence[StrPath] = (),
    threads: int | None = None,
) -> ExportResult:
    """Write one product of a map to a file or a folder, without a run.

    Args:
        map_: The map: of a file that is open, or of a drive that was just mapped, in memory.
        product: Which of `PRODUCTS`, such as ``grid``.
        path: The file, with the suffix of the product, which is replaced if it exists; or the
            folder, which is new or empty. A grid or costmap has an image beside its YAML file.
        changes: Changed settings, as those of `load_config`, such as ``{"grid.max_height_m": 3}``;
            all others are those of the map.
        images: Where drives are now whose images are needed, if not where they were mapped.
        threads: Threads to use; None = all cores.

    Returns:
        Its ``figures``, ``warnings``, and its ``value`` if it is one.
        All is in map axes; `run_export` writes products in the coordinates of a survey.

    Raises:
        ReconError: There is no such product, the path is of another kind, the map is damaged or
            lacks what the product is made from, a setting has no effect, or the file cannot be
            written; what was at the path is left as it was.
    """
    opened: object = map_.map if isinstance(map_, MappedSequence) else map_
    if not isinstance(opened, Map):
        expected = "Map.open(folder), or what map_sequence returns"
        raise SettingsError("not a map", got=type(map_).__name__, expected=expected)
    [product], path = known_products([product], pair=False), Path(path)
    moved, kept = [*map(Path, images)], opened.store.path
    check_target(product, path, () if kept is None else [kept])
    known = opened.first.info.config
    ran = ReconConfig.parse(
        {name: known[name] for name in ReconConfig.model_fields if name in known}
    )
    ran = ran.at_scale(ran.scale)
    settings = load_config(ran, changes)
    check_changes(ran, settings, (*(REMADE if need_rays([product]) else ()), "mesh"))
    if PRODUCTS[product].needs_images:
        open_images(opened, moved)
    cores = threads or available_cores()
    if isinstance(map_, MappedSequence) and settings == ran:
        placed = map_.placed
    else:
        placed = place_map(opened, settings, cores)
    context = ExportContext(opened, placed, settings.mesh, threads=cores, images=moved)
    made = write_product(context, product, path)
    return replace(made, warnings=(*opened.doubts, *made.warnings))


def run_mesh(
    source: Path,
    config: ReconConfig,
    *,
    formats: Sequence[str] = ("ply",),
    out: Path | None = None,
    threads: int | None = None,
) -> ExportSummary | CloudSummary:
    """Reconstruct the surface of a cloud file or of a run's map, and write a MeshLab project.

    A cloud file is meshed in one piece, since its scale is unknown; the cloud of a pair as
    `recon pair` does. The map of a run is meshed in pieces, and faces in observed free space are
    removed.
    """
    check_mesh_formats(formats)
    if source.is_dir():
        refuse_as_target(source, out)
        if not is_pair_run(source):
            settings = run_settings(source).model_copy(update={"mesh": config.mesh})
            return run_export(
                source,
                settings,
                products=["mesh"],
                formats=formats,
                out=out,
                threads=threads,
                command="mesh",
            )
    with Run("mesh", out, config, threads=threads) as run:
        return _of_cloud(source, run, config, formats)


def _of_cloud(
    source: Path,
    run: Run,
    config: ReconConfig,
    formats: Sequence[str],
    products: Sequence[str] = ("mesh",),
    of_run: str | None = None,
) -> CloudSummary:
    """Make products of a cloud file, or of the cloud in a run of `recon pair`, and end the run."""
    camera = camera_of_pair(source) if source.is_dir() else None
    cloud = source / PAIR_CLOUD if source.is_dir() else source
    summary = CloudSummary(cloud=str(cloud), run=of_run)
    if "cloud" in products:
        with reading(cloud):
            cloud.stat()
        with atomic_path(run.path(PAIR_CLOUD)) as temporary:
            copyfile(cloud, temporary)
    if "mesh" in products:
        with run.stage("read"):
            points, layer = read_ply(cloud), run.path(LAYER)
            write_ply(layer, points)
        with run.stage("mesh"), naming(cloud):
            mesh, made = mesh_cloud(points, camera, config.mesh, source)
        write_surface(mesh, camera, layer, formats, run.path(WHOLE))
        covered = made.mesh_coverage
        lacks = () if covered is None else check_coverage(covered)
        summary = replace(summary, mesh=made, warnings=lacks)
    return run.finish(summary, source=str(source), inputs=[cloud])


def run_occupancy(
    run: StrPath,
    config: ReconConfig | None = None,
    *,
    out: StrPath | None = None,
    threads: int | None = None,
) -> ExportSummary | CloudSummary:
    """Make voxels and grid of a run with other settings: what `recon occupancy` does.

    The arguments and errors are those of `run_export`; ``run`` is the folder of a run that mapped a
    drive.
    """
    if is_pair_run(Path(run)):
        raise FormatError("the run made no map: it is one of recon pair", where=run)
    products = ("octomap", "grid")
    return run_export(run, config, products=products, out=out, threads=threads, command="occupancy")
