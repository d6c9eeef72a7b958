"""Values as a notebook shows them."""

from __future__ import annotations

import base64
import html as text
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply
from recon.core.values import Disparity, OccupancyGrid, PointCloud, Trajectory, TriangleMesh
from recon.report import style
from recon.report.scene import T_UPRIGHT_CAMERA, thin_cloud, thin_mesh

_SIZE_IN: Final = (7.0, 4.8)
_MOST: Final = 20_000  # points or faces: as many as can be told apart in a picture


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
    if len(cloud) > _MOST:
        cloud = thin_cloud(cloud, _MOST)
    xyz = cloud.xyz if cloud.frame == "map" else apply(T_UPRIGHT_CAMERA, cloud.xyz)
    colours = xyz[:, 2] if cloud.rgb is None else cloud.rgb / 255
    _upright(figure, xyz).scatter(*xyz.T, c=colours, s=1, depthshade=False)


def _draw_mesh(figure: Figure, mesh: TriangleMesh) -> None:
    """Draw a mesh in map axes; one in those of a camera lies on its back."""
    thin, axes = thin_mesh(mesh, _MOST), _upright(figure, mesh.vertices)
    grey = np.full(thin.faces.shape, 200.0)
    colours = (grey if thin.rgb is None else thin.rgb[thin.faces].mean(axis=1)) / 255
    look = {"facecolors": colours, "edgecolors": colours, "shade": thin.rgb is None}
    if len(thin.faces):
        axes.add_collection3d(Poly3DCollection(thin.vertices[thin.faces], **look))


def _upright(figure: Figure, xyz: NDArray[Any]) -> Any:
    axes: Any = figure.add_subplot(projection="3d", elev=35, azim=-160, proj_type="persp")
    axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    if len(xyz):
        axes.auto_scale_xyz(*xyz.T)
        axes.set_aspect("equal")
    axes.locator_params(axis="z", nbins=3)
    return axes


_DRAWN: Final[dict[type, Callable[[Figure, Any], None]]] = {
    Disparity: _draw_disparity,
    OccupancyGrid: _draw_grid,
    PointCloud: _draw_cloud,
    Trajectory: _draw_path,
    TriangleMesh: _draw_mesh,
}
