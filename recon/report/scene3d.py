"""A cloud, a mesh and paths in 3-D, as plain data for plotly.js.

Arrays are base64-encoded, and the colour of a point is one byte: its index in a palette of at
most 256 colours. A list of ``rgb()`` strings would be ten times the size.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import apply
from recon.core.values import PointCloud, TriangleMesh
from recon.core.values.arrays import Float32, Float64, UInt8
from recon.report.colour import scale_colours, value_range
from recon.report.decimate import quantise_colours, thin_cloud, thin_mesh

MAX_POINTS: Final = 120_000
MAX_FACES: Final = 80_000
HEIGHT_SCALE: Final = "turbo"
# From camera axes (x right, y down, z forward) to x forward and z up.
T_UPRIGHT_CAMERA: Final[Float64] = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_BACKGROUND = "#14181d"
_PATH_COLOURS = ("#ff5252", "#ffb74d", "#81c784")
_OUTLIER_SHARE = 0.002
# Candidate viewpoints: from behind (x is forward), from the sides, and from above.
_TURNS_RAD = np.radians(np.arange(-75.0, 76.0, 15.0))
_ABOVE_RAD = np.radians((25.0, 35.0, 50.0))
_HALF_VIEW = np.array([0.62, 0.36])  # tangents across and up: plotly's 45 degrees, with a margin
_CELLS = np.array([48, 28])  # of the view, to count how much of it is filled
_TRIED_POINTS = 4000
_CENTRED = 4  # rounds of moving the look-at point to the middle of what is seen
_FARTHEST_EYE = 2.2  # in units of plotly: a cube of edge 2 then fills most of the view
_LOOK_AT = (-0.1, -0.1, -0.1)  # nearer than the centre, as near objects fill more of the view
Json = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Scene:
    """The content of a 3-D view, all in one frame.

    Attributes:
        T_view_frame: float64 (4, 4), rotates that frame to x forward and z up.
        cloud: Points, or None.
        mesh: A surface, or None.
        paths: Named camera paths, float64 (N, 3).
        eye_m: Initial viewpoint, view axes; None = above, from where the content fills the view.
    """

    T_view_frame: Float64
    cloud: PointCloud | None = None
    mesh: TriangleMesh | None = None
    paths: Sequence[tuple[str, Float64]] = ()
    eye_m: tuple[float, float, float] | None = None


def plot_scene(scene: Scene, max_points: int = MAX_POINTS, max_faces: int = MAX_FACES) -> Json:
    """The ``data``, ``layout`` and ``config`` that plotly.js draws, and ``colourings``.

    All are plain JSON values. Each colouring has a ``label`` and the ``marker`` fields that are
    applied to the first trace, the cloud, when it is chosen.

    Args:
        scene: What to draw. The mesh is initially hidden if there is also a cloud.
        max_points: The cloud is thinned evenly to at most this number.
        max_faces: The mesh is simplified to about this number of triangles.
    """
    T = scene.T_view_frame
    cloud = None if scene.cloud is None else _without_outliers(scene.cloud)
    traces: list[Json] = []
    colourings: list[Json] = []
    if cloud is not None and len(cloud):
        trace, colourings = _cloud_trace(cloud, T, max_points)
        traces.append(trace)
    if scene.mesh is not None and len(scene.mesh.faces):
        traces.append(_mesh_trace(thin_mesh(scene.mesh, max_faces), T, hidden=bool(traces)))
    for number, (name, path) in enumerate(scene.paths):
        traces.append(_path_trace(name, path, T, _PATH_COLOURS[number % len(_PATH_COLOURS)]))
    config = {"displaylogo": False, "responsive": True, "scrollZoom": True}
    seen = _content(cloud, scene, T)
    box = _bounding_box(seen)
    if scene.eye_m is None:
        eye, look_at = _whole_view((seen - box.mean(axis=0)) * _scale(box))
    else:
        eye, look_at = _eye(scene.eye_m, box), np.array(_LOOK_AT)
    layout = _layout(eye, look_at, box)
    return {"data": traces, "layout": layout, "config": config, "colourings": colourings}


def pack(array: NDArray[Any]) -> Json:
    """Encode an array (N,) for plotly.js: the name of its type, and base64 of its bytes."""
    little = np.asarray(array, dtype=array.dtype.newbyteorder("<"))
    return {
        "dtype": array.dtype.str[1:],
        "bdata": base64.b64encode(little.tobytes()).decode("ascii"),
    }


def _cloud_trace(cloud: PointCloud, T: Float64, max_points: int) -> tuple[Json, list[Json]]:
    """The points, and the available colourings."""
    thinned = thin_cloud(cloud, max_points)
    xyz = apply(T, thinned.xyz)
    colourings = [("height", _height_colouring(xyz))]
    if thinned.rgb is not None:
        colourings.insert(0, ("picture", _colouring(*quantise_colours(thinned.rgb))))
    trace = {
        "type": "scatter3d",
        "mode": "markers",
        "name": f"cloud ({len(thinned):,} of {len(cloud):,} points)",
        "hoverinfo": "skip",
        **_xyz(xyz),
        "marker": {"size": 1.6, "showscale": False, **colourings[0][1]},
    }
    return trace, [{"label": name, "marker": marker} for name, marker in colourings]


def _mesh_trace(mesh: TriangleMesh, T: Float64, *, hidden: bool) -> Json:
    vertices = apply(T, mesh.vertices)
    if mesh.rgb is None:
        colouring: Json = {"color": "#b8c4ce"}
    else:
        # One colour per face, as palette indices cannot be interpolated.
        of_faces = mesh.rgb[mesh.faces].mean(axis=1)
        palette, index = quantise_colours(np.rint(of_faces).astype(np.uint8))
        scale = _colouring(palette, index)
        scale["intensity"] = scale.pop("color")
        colouring = {**scale, "intensitymode": "cell", "showscale": False}
    corners = {axis: pack(mesh.faces[:, n]) for n, axis in enumerate("ijk")}
    return {
        "type": "mesh3d",
        "name": f"mesh ({len(mesh.faces):,} triangles)",
        "hoverinfo": "skip",
        "showlegend": True,
        "visible": "legendonly" if hidden else True,
        "lighting": {"ambient": 0.65, "diffuse": 0.5, "specular": 0.05},
        **_xyz(vertices),
        **corners,
        **colouring,
    }


def _path_trace(name: str, path: Float64, T: Float64, colour: str) -> Json:
    xyz = apply(T, path)
    return {
        "type": "scatter3d",
        "mode": "lines",
        "name": name,
        "line": {"color": colour, "width": 6},
        "hovertemplate": "frame %{pointNumber}<br>x %{x:.2f} y %{y:.2f} z %{z:.2f} m",
        **_xyz(xyz),
    }


def _xyz(points: NDArray[Any]) -> Json:
    return {axis: pack(points[:, n].astype(np.float32)) for n, axis in enumerate("xyz")}


def _colouring(palette: UInt8, index: UInt8) -> Json:
    """A scale with one colour per palette entry, and the index of each point in it."""
    colours = palette if len(palette) > 1 else np.repeat(palette, 2, axis=0)
    last = len(colours) - 1
    scale = [[n / last, f"rgb({r},{g},{b})"] for n, (r, g, b) in enumerate(colours.tolist())]
    return {"color": pack(index), "colorscale": scale, "cmin": 0, "cmax": last}


def _height_colouring(xyz: Float32) -> Json:
    low, high = value_range(xyz[:, 2])
    index = np.clip((xyz[:, 2] - low) / (high - low) * 255.0, 0, 255).astype(np.uint8)
    return _colouring(scale_colours(HEIGHT_SCALE), index)


def _without_outliers(cloud: PointCloud) -> PointCloud:
    """Drop the few points far from all others, which would shrink the rest."""
    if not len(cloud):
        return cloud
    low, high = np.quantile(cloud.xyz, (_OUTLIER_SHARE, 1.0 - _OUTLIER_SHARE), axis=0)
    room = 0.1 * (high - low)
    inside = ((cloud.xyz >= low - room) & (cloud.xyz <= high + room)).all(axis=1)
    return cloud.select(inside)


def _content(cloud: PointCloud | None, scene: Scene, T: Float64) -> Float64:
    """float64 (N, 3): the initially visible points, view axes."""
    parts = [path for _, path in scene.paths]
    if cloud is not None and len(cloud):
        parts.append(cloud.xyz.astype(np.float64))
    elif scene.mesh is not None:
        parts.append(scene.mesh.vertices.astype(np.float64))
    return np.asarray(apply(T, np.concatenate([np.zeros((0, 3)), *parts])))


def _bounding_box(seen: Float64) -> Float64:
    """float64 (2, 3): bounds of points, with a small margin."""
    if not len(seen):
        return np.array([[-1.0] * 3, [1.0] * 3])
    middle, half = (seen.max(axis=0) + seen.min(axis=0)) / 2, np.ptp(seen, axis=0) / 2
    half = np.maximum(half, max(float(half.max()) * 0.02, 0.01))  # nothing is entirely flat
    return np.stack([middle - 1.02 * half, middle + 1.02 * half])


def _scale(box: Float64) -> float:
    """Units of plotly.js per metre: the longest side of the box gets 2 of them."""
    return 2.0 / float(np.ptp(box, axis=0).max())


def _eye(eye_m: tuple[float, float, float], box: Float64) -> Float64:
    """float64 (3,): viewpoint, in units of plotly relative to the centre of the box."""
    eye = (np.asarray(eye_m) - box.mean(axis=0)) * _scale(box)
    # Seen from the position of a long lens, everything would be small in this wider view.
    return np.asarray(eye * min(1.0, _FARTHEST_EYE / max(float(np.linalg.norm(eye)), 1e-9)))


def _whole_view(seen: Float64) -> tuple[Float64, Float64]:
    """The viewpoint that sees all points, and in which they fill most of the view.

    Args:
        seen: float64 (N, 3), in units of plotly relative to the centre of the box.

    Returns:
        float64 (3,) twice: the viewpoint, and the point that it looks at.
    """
    points = seen[:: max(1, len(seen) // _TRIED_POINTS)] if len(seen) else np.zeros((1, 3))
    tried = [_view_from(points, turn, above) for turn in _TURNS_RAD for above in _ABOVE_RAD]
    _, eye, look_at = max(tried, key=lambda view: view[0])
    return eye, look_at


def _view_from(points: Float64, turn_rad: float, above_rad: float) -> tuple[int, Float64, Float64]:
    """The nearest view of all points from one direction: cells filled, viewpoint, look-at point."""
    level = -np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0])
    towards = np.cos(above_rad) * level + [0.0, 0.0, np.sin(above_rad)]
    across = np.array([-level[1], level[0], 0.0])
    axes = np.stack([across, np.cross(towards, across)])
    look_at, place = np.zeros(3), np.zeros((1, 2))
    away = 0.0
    for _ in range(_CENTRED):
        flat, near = (points - look_at) @ axes.T, (points - look_at) @ towards
        # A point at distance z before the eye is in view up to z times the tangent of half of it.
        away = max(float((np.abs(flat) / _HALF_VIEW + near[:, None]).max()), 0.1)
        place = flat / (away - near)[:, None]
        look_at = look_at + away * (place.max(axis=0) + place.min(axis=0)) / 2 @ axes
    cells = np.floor((place / _HALF_VIEW + 1) / 2 * _CELLS)
    # Not to be moved after the last measurement of what is in view.
    centre = look_at - away * (place.max(axis=0) + place.min(axis=0)) / 2 @ axes
    return len(np.unique(cells, axis=0)), centre + away * towards, centre


def _layout(eye: Float64, look_at: Float64, box: Float64) -> Json:
    aspect = dict(zip("xyz", (_scale(box) * np.ptp(box, axis=0)).tolist(), strict=True))
    titles = {"x": "x forward (m)", "y": "y left (m)", "z": "z up (m)"}
    axes = {
        f"{axis}axis": {
            "title": {"text": titles[axis]},
            "range": box[:, n].tolist(),
            "color": "#aab4be",
            "gridcolor": "#2c343c",
            "zeroline": False,
            "showbackground": False,
        }
        for n, axis in enumerate("xyz")
    }
    camera = {
        "eye": dict(zip("xyz", eye.tolist(), strict=True)),
        "center": dict(zip("xyz", look_at.tolist(), strict=True)),
    }
    return {
        "paper_bgcolor": _BACKGROUND,
        "font": {"color": "#dfe5ea"},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {
            "x": 0.0,
            "y": 0.0,
            "yanchor": "bottom",
            "itemsizing": "constant",
            "bgcolor": "rgba(20,24,29,0.8)",
        },
        "uirevision": "kept",  # changing the colouring does not reset the view
        "scene": {"aspectmode": "manual", "aspectratio": aspect, "camera": camera, **axes},
    }
