"""All that leaves a map: the table of its products, and the loop that makes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, cast

from recon.core.errors import MeshingError, SettingsError
from recon.core.values import OccupancyGrid, PointCloud, TriangleMesh
from recon.export.cloud import arrays_product, cloud_product, pcd_product
from recon.export.colmap import colmap_product
from recon.export.costmap import costmap_product
from recon.export.gridmap import gridmap_product
from recon.export.mcap import mcap_product
from recon.export.mesh.pieces import mesh_product
from recon.export.mesh.texture import texture_product
from recon.export.nerfstudio import nerfstudio_product
from recon.export.occupancy import grid_product, octomap_product
from recon.export.product import Made, Order, Product
from recon.export.rasters import RASTERS, raster_product
from recon.export.survey import survey_product
from recon.map.sessions.placed import has_occupancy
from recon.map.store.finished import check_rays

# In the order in which they are made.
PRODUCTS: Final[Mapping[str, Product]] = {
    "cloud": Product(cloud_product),
    "octomap": Product(octomap_product, needs_occupancy=True),
    "grid": Product(grid_product, needs_occupancy=True),
    "costmap": Product(costmap_product, needs_occupancy=True),
    "mesh": Product(mesh_product, surveyed=True),
    "texture": Product(texture_product, needs_images=True, surveyed=True),
    # Their cells, and the ground far from the path, are those of the voxels.
    **{
        name: Product(raster_product(name), needs_occupancy=True, surveyed=True) for name in RASTERS
    },
    "las": Product(survey_product("las"), surveyed=True),
    "laz": Product(survey_product("laz"), surveyed=True),
    "copc": Product(survey_product("copc.laz"), surveyed=True),
    "e57": Product(survey_product("e57"), surveyed=True),
    "pcd": Product(pcd_product),
    "npz": Product(arrays_product),
    "mcap": Product(mcap_product, needs_occupancy=True, surveyed=True),
    "gridmap": Product(gridmap_product, needs_occupancy=True),
    "colmap": Product(colmap_product, needs_images=True),
    "nerfstudio": Product(nerfstudio_product, needs_images=True),
}
USUAL: Final = ("cloud", "octomap", "grid", "mesh")  # unless something else is asked for
OF_A_PAIR: Final = ("cloud", "mesh")


@dataclass(frozen=True, eq=False)
class Products:
    """What is left in memory of products whose files are written, by name; and warnings."""

    made: Mapping[str, Made]
    warnings: tuple[str, ...]

    @property
    def figures(self) -> dict[str, Any]:
        """Their figures for the summary."""
        return {name: value for one in self.made.values() for name, value in one.figures.items()}

    @property
    def cloud(self) -> PointCloud:
        """Even sample of the fused cloud, all points of a small one; frame ``map``."""
        return cast("PointCloud", self.made["cloud"].value)

    @property
    def grid(self) -> OccupancyGrid:
        """The flat grid."""
        return cast("OccupancyGrid", self.made["grid"].value)

    @property
    def camera_height_m(self) -> float | None:
        """Height of the camera above the ground; None = unknown, or not steady."""
        return cast("float | None", self.made["grid"].figures["camera_height_m"])

    @property
    def mesh(self) -> TriangleMesh | None:
        """The surface in map axes; None = not made, or too large for memory."""
        return self.made["mesh"].value if "mesh" in self.made else None


def make(order: Order, products: Sequence[str] = USUAL) -> Products:
    """Make any of `PRODUCTS` of a map, and write them into the folder of a run.

    A surface that cannot be made is a warning where something else is asked for.
    """
    made: dict[str, Made] = {}
    warnings: list[str] = []
    for name in (name for name in PRODUCTS if name in products):
        product, run, settings = PRODUCTS[name], order.run, order.placed.tiles.config
        if product.needs_occupancy and not has_occupancy(order.map):
            check_rays(order.map.first, settings)
        try:
            with run.stage(name):
                made[name] = product.write(order)
        except MeshingError as error:
            if len(products) == 1:
                raise
            warnings.append(f"no mesh: {error}")
        else:
            warnings += made[name].warnings
        settings.memory.check(name)
    return Products(made, tuple(dict.fromkeys(warnings)))  # two may say the same


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
