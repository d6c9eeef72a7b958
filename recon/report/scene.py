"""A cloud, a mesh and paths in 3-D, as plain data for plotly.js, thinned for display.

The colour of a point is its index in a palette: ``rgb()`` strings would be ten times the size.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from plotly import graph_objects as go
from plotly.colors import get_colorscale

from recon.core.geometry.se3 import apply
from recon.core.text import counted
from recon.core.values import PointCloud, TriangleMesh
from recon.core.values.arrays import Float32, Float64, UInt8
from recon.report import style

MAX_POINTS: Final = 120_000
MAX_FACES: Final = 80_000
# From camera axes (x right, y down, z forward) to x forward and z up.
T_UPRIGHT_CAMERA: Final[Float64] = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_TITLES: Final = {"x": "x forward (m)", "y": "y left (m)", "z": "z up (m)"}
_AXIS: Final = {
    "color": "#aab4be", "gridcolor": "#2c343c", "zeroline": False, "showbackground": False,
}  # fmt: skip
_LAYOUT: Final = {
    "template": "none",
    "paper_bgcolor": "#14181d",
    "font_color": "#dfe5ea",
    "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
    "legend": {
        "x": 0.0, "y": 0.0, "yanchor": "bottom", "itemsizing": "constant",
        "bgcolor": "rgba(20,24,29,0.8)",
    },
    "uirevision": "kept",  # changing the colouring does not reset the view
    "scene_aspectmode": "manual",
}  # fmt: skip
# By its colours, as plotly.js does not know the name.
_TURBO: Final = get_colorscale("Turbo")
_PATH_COLOURS: Final = ("#ff5252", "#ffb74d", "#81c784")
_OUTLIER_RATIO: Final = 0.002
# Candidate viewpoints: from behind (x is forward), from the sides, and from above.
_TURNS_RAD: Final = np.radians(np.arange(-75.0, 76.0, 15.0))
_ABOVE_RAD: Final = np.radians((25.0, 35.0, 50.0))
# Tangents across and up: plotly's 45 degrees, with a margin.
_HALF_VIEW: Final = np.array([0.62, 0.36])
_CELLS: Final = np.array([48, 28])  # of the view, to count how much of it is filled
_TRIED_POINTS: Final = 4000
_CENTRED: Final = 4  # rounds of moving the look-at point to the middle of what is seen
_FARTHEST_EYE: Final = 2.2  # in units of plotly: a cube of edge 2 then fills most of the view
# Nearer than the centre, as near objects fill more of the view.
_LOOK_AT: Final = np.full(3, -0.1)
Json = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Scene:
    """The content of a 3-D view, all in one frame."""

    T_view_frame: Float64  # turns it to x forward, z up
    cloud: PointCloud | None = None
    mesh: TriangleMesh | None = None
    paths: Sequence[tuple[str, Float64]] = ()  # names and positions (N, 3) of cameras
    eye_m: tuple[float, float, float] | None = None  # in view axes; None = where all is in view


def plot_scene(scene: Scene, max_points: int = MAX_POINTS) -> Json | None:
    """Return the ``data`` and ``layout`` that plotly.js draws; None without point and triangle.

    ``layout.meta`` lists the colourings of the cloud, the first trace: ``label``, and its
    ``marker``.
    """
    T = scene.T_view_frame
    cloud = None if scene.cloud is None else _without_outliers(scene.cloud)
    figure = go.Figure(layout=_LAYOUT)
    if cloud is not None and len(cloud):
        thinned = thin_cloud(cloud, max_points)
        colourings = _colourings(thinned, apply(T, thinned.xyz))
        figure.add_trace(_cloud_trace(thinned, len(cloud), T, colourings[0]["marker"]))
        figure.layout.meta = colourings
    if scene.mesh is not None and len(scene.mesh.faces):
        thin, hidden = thin_mesh(scene.mesh, MAX_FACES), bool(figure.data)
        figure.add_trace(_mesh_trace(thin, T, hidden=hidden))
    if not figure.data:
        return None
    for (name, path), colour in zip(scene.paths, itertools.cycle(_PATH_COLOURS), strict=False):
        look: Json = {"mode": "lines", "line": {"color": colour, "width": 6}}
        look["hovertemplate"] = "frame %{pointNumber}<br>x %{x:.5r} y %{y:.5r} z %{z:.5r} m"
        figure.add_trace(go.Scatter3d(name=name, **look, **_xyz(apply(T, path))))
    _set_view(figure, scene, _visible_points(cloud, scene))
    return dict(json.loads(figure.to_json()))


def quantise_colours(rgb: UInt8) -> tuple[UInt8, UInt8]:
    """Return a palette of colours (N, 3): uint8 (P, 3), P <= 256, and uint8 (N,) indices in it."""
    if not len(rgb):
        return np.zeros((1, 3), dtype=np.uint8), np.zeros(0, dtype=np.uint8)
    image = Image.fromarray(rgb[None]).quantize(256, Image.Quantize.MEDIANCUT)
    palette = np.array(image.getpalette(), dtype=np.uint8).reshape(-1, 3)
    return palette, np.asarray(image)[0]


def _cloud_trace(thinned: PointCloud, points: int, T: Float64, marker: Json) -> go.Scatter3d:
    return go.Scatter3d(
        mode="markers",
        name=f"cloud ({len(thinned):,} of {counted(points, 'point', form=',')})",
        hoverinfo="skip",
        marker={"size": 1.6, "showscale": False, **marker},
        **_xyz(apply(T, thinned.xyz)),
    )


def _mesh_trace(mesh: TriangleMesh, T: Float64, *, hidden: bool) -> go.Mesh3d:
    colouring: Json = {"color": "#b8c4ce"}
    if mesh.rgb is not None:
        # One colour per face, as palette indices cannot be interpolated.
        colouring = _palette_scale(np.rint(mesh.rgb[mesh.faces].mean(axis=1)).astype(np.uint8))
        colouring |= {"intensity": colouring.pop("color"), "intensitymode": "cell"}
    return go.Mesh3d(
        name=f"mesh ({counted(len(mesh.faces), 'triangle', form=',')})",
        hoverinfo="skip",
        showlegend=True,
        showscale=False,
        visible="legendonly" if hidden else True,
        lighting={"ambient": 0.65, "diffuse": 0.5, "specular": 0.05},
        **_xyz(apply(T, mesh.vertices)),
        **dict(zip("ijk", mesh.faces.T, strict=True)),
        **colouring,
    )


def _xyz(points: NDArray[Any]) -> Json:
    return dict(zip("xyz", points.astype(np.float32).T, strict=True))


def _colourings(cloud: PointCloud, xyz: Float32) -> list[Json]:
    low, high = style.value_range(xyz[:, 2])
    height = np.clip((xyz[:, 2] - low) / (high - low) * 255.0, 0, 255).astype(np.uint8)
    scale = {"color": height, "colorscale": _TURBO, "cmin": 0, "cmax": 255}
    by_image = [] if cloud.rgb is None else [("image", _palette_scale(cloud.rgb))]
    return [{"label": by, "marker": marker} for by, marker in (*by_image, ("height", scale))]


def _palette_scale(rgb: UInt8) -> Json:
    """Return a scale with one colour per palette entry, and the index of each point in it."""
    palette, index = quantise_colours(rgb)
    colours = palette if len(palette) > 1 else np.repeat(palette, 2, axis=0)
    last = len(colours) - 1
    scale = [[n / last, f"rgb({r},{g},{b})"] for n, (r, g, b) in enumerate(colours.tolist())]
    return {"color": index, "colorscale": scale, "cmin": 0, "cmax": last}


def _without_outliers(cloud: PointCloud) -> PointCloud:
    """Drop the few points far from all others, which would shrink the rest."""
    if not len(cloud):
        return cloud
    low, high = np.quantile(cloud.xyz, (_OUTLIER_RATIO, 1.0 - _OUTLIER_RATIO), axis=0)
    room = 0.1 * (high - low)
    inside = ((cloud.xyz >= low - room) & (cloud.xyz <= high + room)).all(axis=1)
    return cloud.select(inside)


def _visible_points(cloud: PointCloud | None, scene: Scene) -> Float64:
    """Return float64 (N, 3): the initially visible points, view axes."""
    points: list[NDArray[Any]] = [np.zeros((0, 3)), *(path for _, path in scene.paths)]
    if cloud is not None and len(cloud):
        points.append(cloud.xyz)
    elif scene.mesh is not None:
        points.append(scene.mesh.vertices)
    return np.asarray(apply(scene.T_view_frame, np.concatenate(points)))


def _set_view(figure: go.Figure, scene: Scene, seen: Float64) -> None:
    box = _bounding_box(seen)
    # Units of plotly.js: the longest side of the box gets 2 of them.
    unit = 2.0 / float(np.ptp(box, axis=0).max())
    if scene.eye_m is None:
        eye, look_at = _whole_view((seen - box.mean(axis=0)) * unit)
    else:
        eye, look_at = (np.asarray(scene.eye_m) - box.mean(axis=0)) * unit, _LOOK_AT
        # Seen from the position of a long lens, everything would be small in this wider view.
        eye *= min(1.0, _FARTHEST_EYE / max(float(np.linalg.norm(eye)), 1e-9))
    sides = unit * np.ptp(box, axis=0)
    aspect, *view = (dict(zip("xyz", x.tolist(), strict=True)) for x in (sides, eye, look_at))
    camera = dict(zip(("eye", "center"), view, strict=True))
    figure.update_layout(scene_aspectratio=aspect, scene_camera=camera)
    for n, (axis, title) in enumerate(_TITLES.items()):
        axes = {"title_text": title, "range": box[:, n].tolist(), **_AXIS}
        figure.layout.scene[f"{axis}axis"].update(axes)


def _bounding_box(seen: Float64) -> Float64:
    """Return float64 (2, 3): bounds of points, with a small margin."""
    if not len(seen):
        return np.array([[-1.0] * 3, [1.0] * 3])
    middle, half = (seen.max(axis=0) + seen.min(axis=0)) / 2, np.ptp(seen, axis=0) / 2
    half = np.maximum(half, max(float(half.max()) * 0.02, 0.01))  # nothing is entirely flat
    return np.stack([middle - 1.02 * half, middle + 1.02 * half])


def _whole_view(seen: Float64) -> tuple[Float64, Float64]:
    """Return viewpoint and look-at point from which all points (N, 3) fill the view."""
    points = seen[:: max(1, len(seen) // _TRIED_POINTS)] if len(seen) else np.zeros((1, 3))
    tried = [_view_from(points, turn, above) for turn in _TURNS_RAD for above in _ABOVE_RAD]
    _, eye, look_at = max(tried, key=lambda view: view[0])
    return eye, look_at


def _view_from(points: Float64, turn_rad: float, above_rad: float) -> tuple[int, Float64, Float64]:
    """Return the nearest view of all points from one direction: filled cells, eye, look-at."""
    level = -np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0])
    towards = np.cos(above_rad) * level + [0.0, 0.0, np.sin(above_rad)]
    across = np.array([-level[1], level[0], 0.0])
    axes = np.stack([across, np.cross(towards, across)])
    look_at, place, away = np.zeros(3), np.zeros((1, 2)), 0.0
    for _ in range(_CENTRED):
        flat, near = (points - look_at) @ axes.T, (points - look_at) @ towards
        # A point at distance z before the eye is in view up to z times the tangent of half of it.
        away = max(float((np.abs(flat) / _HALF_VIEW + near[:, None]).max()), 0.1)
        place = flat / (away - near)[:, None]
        look_at = look_at + away * (place.max(axis=0) + place.min(axis=0)) / 2 @ axes
    cells = np.floor((place / _HALF_VIEW + 1) / 2 * _CELLS)
    # Not to be moved after the last measurement of what is in view.
    centre = look_at - away * (place.max(axis=0) + place.min(axis=0)) / 2 @ axes
    return len(np.unique(cells @ [1, 1j])), centre + away * towards, centre


def thin_cloud(cloud: PointCloud, limit: int) -> PointCloud:
    """Return at most ``limit`` points, evenly spread: the first of each cell of a coarse grid."""
    kept = np.arange(len(cloud))
    longest_m = float(np.ptp(cloud.xyz, axis=0).max()) if len(cloud) else 0.0
    # At first more than ``limit`` cells on a face of the bounding cube.
    cell_m = max(longest_m / (4.0 * math.sqrt(limit)), 1e-6)
    while len(kept) > limit:
        kept = np.sort(np.unique(_cell_numbers(cloud.xyz, cell_m), return_index=True)[1])
        cell_m *= max(math.sqrt(len(kept) / limit), 1.02)
    return cloud.select(kept)


def thin_mesh(mesh: TriangleMesh, limit: int) -> TriangleMesh:
    """Return at most about ``limit`` triangles for display, by merging vertices in cells."""
    # Open3D's quadric decimation takes nine times as long, and drops the colours.
    if len(mesh.faces) <= limit:
        return mesh
    cell_m, thinned, edge_m = 0.0, mesh, _typical_edge_m(mesh)
    while len(thinned.faces) > limit:
        # The number of triangles falls with the square of the cell size.
        cell_m = max(cell_m * math.sqrt(len(thinned.faces) / limit) * 1.05, edge_m)
        thinned = _merge_vertices(mesh, cell_m)
    return thinned


def _cell_numbers(xyz: NDArray[Any], cell_m: float) -> NDArray[np.int64]:
    cells = np.floor((xyz - xyz.min(axis=0)) / cell_m).astype(np.int64)
    return np.asarray(np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1)))


def _merge_vertices(mesh: TriangleMesh, cell_m: float) -> TriangleMesh:
    numbers = _cell_numbers(mesh.vertices, cell_m)
    _, first, cell = np.unique(numbers, return_index=True, return_inverse=True)
    faces = cell.reshape(-1)[mesh.faces].astype(np.int32)
    a, b, c = faces.T
    rgb = None if mesh.rgb is None else mesh.rgb[first]
    return TriangleMesh(mesh.vertices[first], faces[(a != b) & (b != c) & (c != a)], rgb=rgb)


def _typical_edge_m(mesh: TriangleMesh) -> float:
    first, second = mesh.vertices[mesh.faces[:, :2]].swapaxes(0, 1)
    edge_m = float(np.median(np.linalg.norm(first - second, axis=1)))
    # At most 1e5 cells per side, so that cell numbers fit in an int64.
    return max(edge_m, float(np.ptp(mesh.vertices, axis=0).max()) * 1e-5, 1e-6)
