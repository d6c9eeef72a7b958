"""All that leaves a map: the table of its products, and the loop that makes them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, TypeVar, cast

import numpy as np

from recon.core.errors import MappingError, MeshingError, OutputError, SettingsError
from recon.core.progress import stage
from recon.core.text import metres
from recon.core.values import OccupancyGrid, PointCloud, TriangleMesh
from recon.core.values.arrays import Float64
from recon.core.work import Stopwatch
from recon.export.cloud import (
    arrays_product,
    cloud_product,
    copc_product,
    e57_product,
    las_product,
    pcd_product,
)
from recon.export.colmap import colmap_product
from recon.export.contours import contours_product
from recon.export.costmap import costmap_product, gridmap_product
from recon.export.mcap import mcap_product
from recon.export.mesh.pieces import mesh_product
from recon.export.mesh.texture import texture_product
from recon.export.nerfstudio import nerfstudio_product
from recon.export.occupancy import (
    Flattening,
    GridFigures,
    esdf_product,
    grid_product,
    octomap_product,
)
from recon.export.orthophoto import orthophoto_product
from recon.export.product import ExportContext, ExportResult, Product, ProductFigures
from recon.export.rasters import RASTERS, raster_product, stem_of
from recon.export.web import web_product
from recon.io.atomic import check_targets, writing_to
from recon.io.models.mesh import MESH_SUFFIXES
from recon.map.ground.surface import BIN_M
from recon.map.sessions.placed import check_rays, has_occupancy

# In the order in which they are made.
PRODUCTS: Final[Mapping[str, Product]] = {
    "cloud": Product("map/cloud.ply", cloud_product),
    "octomap": Product("map/octomap.bt", octomap_product, (".ot",), needs_occupancy=True),
    "grid": Product("map/grid.yaml", grid_product, parts=(".pgm", ".wld"), needs_occupancy=True),
    "esdf": Product("map/esdf.npz", esdf_product, needs_occupancy=True),
    "costmap": Product(
        "map/costmap.yaml", costmap_product, parts=(".png", ".wld"), needs_occupancy=True
    ),
    "mesh": Product("mesh/mesh.ply", mesh_product, MESH_SUFFIXES[1:], surveyed=True),
    "texture": Product("texture/mesh.glb", texture_product, needs_images=True, surveyed=True),
    # Their cells, and the ground far from the path, are those of the voxels.
    **{
        name: Product(
            f"map/{stem_of(name)}.tif", raster_product(name), needs_occupancy=True, surveyed=True
        )
        for name in RASTERS
    },
    "orthophoto": Product(
        "map/orthophoto.tif",
        orthophoto_product,
        needs_occupancy=True,
        surveyed=True,
        needs_images=True,
    ),
    "contours": Product("map/contours.gpkg", contours_product, needs_occupancy=True, surveyed=True),
    "las": Product("map/cloud.las", las_product, surveyed=True),
    "laz": Product("map/cloud.laz", las_product, surveyed=True),
    "copc": Product("map/cloud.copc.laz", copc_product, surveyed=True),
    "e57": Product("map/cloud.e57", e57_product, surveyed=True),
    "pcd": Product("map/cloud.pcd", pcd_product),
    "npz": Product("map/map.npz", arrays_product),
    "mcap": Product("bag", mcap_product, needs_occupancy=True, surveyed=True),
    "web": Product("web", web_product, needs_occupancy=True, surveyed=True),
    "gridmap": Product("gridmap", gridmap_product, needs_occupancy=True),
    "colmap": Product("colmap", colmap_product, needs_images=True),
    "nerfstudio": Product("nerfstudio", nerfstudio_product, needs_images=True),
}
USUAL: Final = ("cloud", "octomap", "grid", "mesh")  # unless something else is asked for
OF_A_PAIR: Final = ("cloud", "mesh")
_DOUBTED: Final = 2.0  # standard deviations between two heights, of which one is wrong then
F = TypeVar("F", bound=ProductFigures)


@dataclass(frozen=True, eq=False)
class Products:
    """What is left in memory of products whose files are written, by name; and warnings."""

    made: Mapping[str, ExportResult]
    warnings: tuple[str, ...]

    @property
    def figures(self) -> Mapping[str, ProductFigures]:
        """The figures of each."""
        return {name: one.figures for name, one in self.made.items()}

    def figures_of(self, kind: type[F]) -> F:
        """Return the figures of the product that has such ones."""
        return next(one for one in self.figures.values() if isinstance(one, kind))

    @property
    def cloud(self) -> PointCloud:
        """Even sample of the fused cloud, all points of a small one; frame ``map``."""
        return cast("PointCloud", self.made["cloud"].value)

    @property
    def grid(self) -> OccupancyGrid:
        """The flat grid."""
        return cast("OccupancyGrid", self.made["grid"].value)

    @property
    def T_base_camera(self) -> Float64:
        """Where the camera is on the vehicle, float64 (4, 4)."""
        return self.figures_of(GridFigures).T_base_camera

    @property
    def mesh(self) -> TriangleMesh | None:
        """The surface in map axes; None = not made, or too large for memory."""
        return self.made["mesh"].value if "mesh" in self.made else None


def make(
    context: ExportContext,
    folder: Path,
    products: Sequence[str] = USUAL,
    watch: Stopwatch | None = None,
) -> Products:
    """Make any of `PRODUCTS` of a map, and write them into a folder, under their names.

    A surface that cannot be made is a warning where something else is asked for.
    """
    made: dict[str, ExportResult] = {}
    warnings: list[str] = []
    for name in (name for name in PRODUCTS if name in products):
        stage(name)
        try:
            with (watch or Stopwatch()).stage(name):
                made[name] = _written(context, name, folder / PRODUCTS[name].name)
        except MeshingError as error:
            if len(products) == 1:
                raise
            warnings.append(f"no mesh: {error}")
        else:
            warnings += made[name].warnings
        context.placed.tiles.config.memory.check(name)
    return Products(made, tuple(dict.fromkeys(warnings)))  # two may say the same


def _written(context: ExportContext, name: str, path: Path) -> ExportResult:
    doubts: list[str] = []
    if PRODUCTS[name].needs_occupancy:
        if not has_occupancy(context.map):
            check_rays(context.map.first, context.placed.tiles.config)
        doubts = _stand_on_mounts(context)
    path.parent.mkdir(parents=True, exist_ok=True)
    made = PRODUCTS[name].write(context, path)
    return replace(made, warnings=[*doubts, *made.warnings])


def _stand_on_mounts(context: ExportContext) -> list[str]:
    """Let products be made with the height of the camera that all robots state; return doubts.

    A height that is set wins over it; so does the ground that was seen, where it contradicts it.
    """
    placed, mounts = context.placed, [one.mount for one in context.map.linked]
    config, ground = placed.tiles.config, placed.tiles.config.ground
    height_m, *others = {None if one is None else one.camera_height_m for one in mounts}
    if height_m is None or others or ground.camera_height_m is not None:
        return []
    for _, surface in islice(Flattening(placed).grounds(), 1):
        seen_m = surface.camera_height_m  # along the whole path
        off_m = np.abs(surface.drop_at(placed.path_m[:, :2]) - seen_m)
        sigma_m = 1.4826 * float(np.nanmedian(np.append(off_m, 0.0)))  # of a normal distribution
        if abs(seen_m - height_m) > _DOUBTED * np.hypot(sigma_m, BIN_M):
            said = f"the static transforms put the camera {metres(height_m)} above the ground"
            seen = f"{metres(seen_m)} ± {metres(sigma_m)}"
            return [f"{said}, and it is {seen}, which the grid follows"]
    known = ground.model_copy(update={"camera_height_m": height_m})
    placed.tiles.config = config.model_copy(update={"ground": known})
    return []


def check_target(name: str, path: Path, inputs: Iterable[Path]) -> None:
    """Refuse to write a product to a path of another kind, or to one that would replace an input.

    A folder may exist if there is nothing in it, a file if it is a regular one.
    """
    product = PRODUCTS[name]
    stem, end = product.stem_and_suffix(path)
    if product.suffix:
        check_targets((path.with_name(stem + one) for one in (*product.parts, end)), inputs)
    elif path.is_symlink() or (path.exists() and not (path.is_dir() and not any(path.iterdir()))):
        what, expected = "the folder exists already", "an empty folder, or none yet"
        raise OutputError(what, where=path, expected=expected)


def write_product(context: ExportContext, name: str, path: Path) -> ExportResult:
    """Write a product to a file or a folder of any name: all of it, or nothing.

    What it has beside it in a run, besides files that belong to it, is not kept.
    """
    product = PRODUCTS[name]
    stem, end = product.stem_and_suffix(path)
    with writing_to(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=f".{path.name}-", dir=path.parent) as folder:
            staged = (Path(folder) / product.name).with_name(stem + product.suffix)
            made = _written(replace(context, formats=(end[1:].lower(),)), name, staged)
            for one in (*product.parts, end):
                file = staged.with_name(stem + one.lower())
                if not file.exists():  # the largest OctoMaps are not written
                    raise MappingError("; ".join(made.warnings), where=path)
                file.replace(path.with_name(stem + one))
    return made


def known_products(products: Sequence[str], *, pair: bool) -> Sequence[str]:
    """Return the requested products, or the usual ones."""
    possible = OF_A_PAIR if pair else (*PRODUCTS,)
    for product in products:
        if product not in possible:
            what, hint = "unknown product", None
            if product in PRODUCTS:
                what, hint = "a pair has no such product", "recon map makes it of a drive"
            expected = ", ".join(possible)
            raise SettingsError(what, where="--to", got=product, expected=expected, hint=hint)
    return list(dict.fromkeys(products)) or (OF_A_PAIR if pair else USUAL)


def need_rays(products: Sequence[str]) -> bool:
    """Return whether products are made of rays, so that their cells can be others."""
    return any(PRODUCTS[name].needs_occupancy for name in products)
