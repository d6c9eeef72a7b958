"""Values as a notebook shows them."""

from __future__ import annotations

import base64
import html as text
import io
from collections.abc import Callable
from typing import Any, Final

from matplotlib.figure import Figure
from PIL import Image

from recon.core.values import Disparity, OccupancyGrid, PointCloud, Trajectory, TriangleMesh
from recon.report import style
from recon.report.scene import Points, Scene, upright_scene
from recon.report.view3d import draw_still, view_of

_SIZE_IN: Final = (7.0, 4.8)
_MOST: Final = 60_000  # points: as many as can be told apart in a picture


class Picture(Figure):
    """A figure that a notebook shows without pyplot, whatever its backend."""

    def _repr_png_(self) -> bytes:
        return style.to_png(self)


@style.styled
def plot(value: Any) -> Picture:
    """Draw a value of one of the types in `_DRAWN`."""
    figure = Picture(_SIZE_IN)
    _DRAWN[type(value)](figure, value)
    figure.suptitle(repr(value), fontsize=8, wrap=True)
    return figure


def html(value: Any) -> str:
    """Return the picture of a value as HTML that needs no other file."""
    png = base64.b64encode(style.to_png(plot(value))).decode()
    return f'<img src="data:image/png;base64,{png}" alt="{text.escape(repr(value))}">'


def _draw_disparity(figure: Figure, disparity: Disparity) -> None:
    axes, limits = figure.subplots(), style.value_range(disparity.values)
    axes.set(facecolor=style.unit_colour(style.MISSING), xlabel="column (px)", ylabel="row (px)")
    axes.grid(visible=False)
    look: dict[str, Any] = {"cmap": style.DISPARITY_SCALE, "vmin": limits[0], "vmax": limits[1]}
    figure.colorbar(axes.imshow(disparity.values, **look), label="disparity (px)", shrink=0.8)
    if disparity.inferred.any():
        colours = style.colour_disparity(disparity.values, limits)
        axes.imshow(style.hatch(colours, disparity.inferred))
        axes.legend(handles=[style.hatch_key()], loc="lower left")


def _draw_grid(figure: Figure, grid: OccupancyGrid) -> None:
    axes, (x_m, y_m), (rows, columns) = figure.subplots(), grid.origin_m, grid.cells.shape
    right_m, top_m = x_m + columns * grid.resolution_m, y_m + rows * grid.resolution_m
    axes.imshow(style.colour_grid(grid), extent=(x_m, right_m, y_m, top_m))
    axes.set(xlabel="x, forward (m)", ylabel="y, left (m)")
    axes.grid(visible=False)


def _draw_path(figure: Figure, path: Trajectory) -> None:
    axes = figure.subplots()
    axes.plot(path.positions_m[:, 0], path.positions_m[:, 2], ".-", color=style.ESTIMATE)
    axes.set(xlabel="x, right (m)", ylabel="z, forward (m)")
    axes.set_aspect("equal", adjustable="datalim")


def _draw_cloud(figure: Figure, cloud: PointCloud) -> None:
    in_map = cloud.frame == "map"
    _draw_scene(figure, Scene((Points("cloud", cloud),)) if in_map else upright_scene(cloud))


def _draw_mesh(figure: Figure, mesh: TriangleMesh) -> None:
    """Draw a mesh in map axes; one in those of a camera lies on its back."""
    _draw_scene(figure, Scene(mesh=mesh))


def _draw_scene(figure: Figure, scene: Scene) -> None:
    axes = figure.subplots()
    axes.set_axis_off()
    if not scene.empty:
        with Image.open(io.BytesIO(draw_still(view_of(scene, _MOST)))) as image:
            axes.imshow(image)


_DRAWN: Final[dict[type, Callable[[Figure, Any], None]]] = {
    Disparity: _draw_disparity,
    OccupancyGrid: _draw_grid,
    PointCloud: _draw_cloud,
    Trajectory: _draw_path,
    TriangleMesh: _draw_mesh,
}
