"""`recon export`: products of a finished run, with other settings or formats."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from recon.commands.config import ReconConfig, check_changes, run_settings
from recon.commands.occupancy import REMADE
from recon.core.errors import SettingsError
from recon.export.remake import (
    ON_REQUEST,
    Wanted,
    copy_file,
    from_rays,
    known_products,
    mesh_cloud,
    remake_map,
)
from recon.io.files import StrPath
from recon.io.models.las import check_crs
from recon.io.models.mesh import check_mesh_formats
from recon.map.sessions.measured import Survey
from recon.map.sessions.spread import place_map_on
from recon.run.batch.cluster import BatchOptions
from recon.run.finished import (
    PAIR_CLOUD,
    camera_of_pair,
    is_pair_run,
    open_run,
    refuse_as_target,
)
from recon.run.run import Run


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
) -> dict[str, Any]:
    """Make products of a finished run, and write them.

    Args:
        source: Folder of a run of map, demo or pair.
        config: Its settings with changes, such as ``load_config(f"{source}/config.yaml",
            ["grid.max_height_m=3"])``; None = its own.
        products: Which of `PRODUCTS` and `ON_REQUEST`; empty = those of `PRODUCTS` that such a
            run can give.
        formats: Formats of the mesh, such as ``("ply", "glb")``.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores.
        workers: Where the tiles of grid and OctoMap are made; None = here. Changes no product.
        survey: Measured positions in whose coordinates LAS and LAZ are written; None = in those
            of the map.

    Returns:
        The figures of ``summary.json``.

    Raises:
        ReconError: There is no such product, the run is damaged or lacks what a product is made
            from, a setting has no effect, or the folder cannot be written; nothing is left behind.
    """
    source = Path(source)
    check_mesh_formats(formats)
    pair = is_pair_run(source)
    wanted = known_products(products, pair=pair)
    refuse_as_target(source, out)
    if survey is not None:
        _check_survey(survey, wanted)
    if workers is not None and not from_rays(wanted):
        raise SettingsError(
            "only grids and OctoMaps are made on workers",
            got=", ".join(wanted),
            hint="drop --workers and --scheduler; a mesh uses --threads",
        )
    if pair:
        settings = config or run_settings(source)
        with Run("export", out, settings, threads=threads) as run:
            return _export_pair(source, settings, wanted, run, formats)
    mapped, ran = open_run(source), run_settings(source)
    settings = config or ran
    check_changes(ran, settings, (*(REMADE if from_rays(wanted) else ()), "mesh"))
    with Run("export", out, settings, threads=threads) as run:
        if workers is None:
            what = Wanted(wanted, settings.mesh, formats, survey=survey)
            return remake_map(mapped, settings, what, run)
        with workers.connect() as cluster:
            folder = run.state("tiles").resolve()
            place = partial(place_map_on, folder=folder, each=cluster.each, workers=cluster.at_once)
            what = Wanted(wanted, settings.mesh, formats, place, survey)
            return remake_map(mapped, settings, what, run)


def _export_pair(
    source: Path, config: ReconConfig, products: Sequence[str], run: Run, formats: Sequence[str]
) -> dict[str, Any]:
    """Return products of a run of `recon pair`."""
    cloud, camera = source / PAIR_CLOUD, camera_of_pair(source)
    figures: dict[str, Any] = {"run": str(source), "cloud": str(cloud), "warnings": []}
    if "cloud" in products:
        copy_file(cloud, run.path(PAIR_CLOUD))
    if "mesh" in products:
        figures |= mesh_cloud(cloud, camera, config.mesh, run, formats)
    run.finish(figures, source=str(source), inputs=[cloud])
    return figures


def _check_survey(survey: Survey, products: Sequence[str]) -> None:
    """Refuse a coordinate system that there is not, and one for nothing.

    Raises:
        SettingsError: So it is.
    """
    if not set(products) & set(ON_REQUEST):
        raise SettingsError(
            "only LAS and LAZ have the coordinates of a survey",
            where="--to",
            got=", ".join(products),
            expected=" or ".join(ON_REQUEST),
        )
    if survey.crs is not None:
        check_crs(survey.crs)
