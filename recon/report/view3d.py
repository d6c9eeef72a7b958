"""A scene as a page shows it: data for plotly.js, and a picture for paper and without JavaScript.

The colour of a point is its index in a palette: ``rgb()`` strings would be ten times the size.
"""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recon.core.text import counted
from recon.core.values import TriangleMesh, join_clouds
from recon.core.values.arrays import Float64, UInt8
from recon.report import style
from recon.report.scene import (
    Points,
    Scene,
    colours,
    first_view,
    known_colourings,
    near_others,
    thin_cloud,
    thin_mesh,
)

MAX_FACES: Final = 80_000
Json = dict[str, Any]
_AXES: Final = {
    name: {
        "title": {"text": title}, "color": "#aab4be", "gridcolor": "#2c343c", "zeroline": False,
        "showbackground": False,
    }
    for name, title in (("x", "x forward (m)"), ("y", "y left (m)"), ("z", "z up (m)"))
}  # fmt: skip
_LAYOUT: Final = {
    "paper_bgcolor": "#14181d",
    "font": {"color": "#dfe5ea"},
    "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
    "legend": {
        "x": 0.0, "y": 0.0, "yanchor": "bottom", "itemsizing": "constant",
        "bgcolor": "rgba(20,24,29,0.8)",
    },
    "uirevision": "kept",  # changing the colouring does not reset the view
}  # fmt: skip
# Tangents across and up: plotly's 45 degrees, with a margin.
_HALF_VIEW: Final = (0.62, 0.36)
_FIELD_RAD: Final = math.radians(45.0)  # plotly's field of view, from bottom to top
_FARTHEST_EYE: Final = 2.2  # in units of plotly: a cube of edge 2 then fills most of the view
# Nearer than the centre, as near objects fill more of the view.
_LOOK_AT: Final = np.full(3, -0.1)
_GREY: Final = (184, 196, 206)  # of a surface without colours
_SIZE_PX: Final = np.array([1240.0, 700.0])  # of the picture: columns, rows
_STEPS: Final = 4000  # of which a path is drawn in it
_SQUARES_PX: Final = (2, 7)  # least and largest side of what stands for a point


@dataclass(frozen=True, eq=False)
class View:
    """A scene that is small enough for a page, and from where it is seen.

    Attributes:
        scene: At most one part, whose name says how many of its points are left.
        box: float64 (2, 3), bounds of what is seen.
        eye, centre: (3,), where the camera is and what it looks at, in units of plotly: the middle
            of the box is 0, and its longest side has 2 of them.
    """

    scene: Scene
    box: Float64
    eye: Float64
    centre: Float64

    @property
    def sides(self) -> Float64:
        """The sides of the box in units of plotly."""
        size_m = np.ptp(self.box, axis=0)
        return np.asarray(2.0 * size_m / size_m.max())

    @property
    def mesh_name(self) -> str:
        """The name of the surface; "" if there is none."""
        mesh = self.scene.mesh
        return "" if mesh is None else f"mesh ({counted(len(mesh.faces), 'triangle', form=',')})"


def view_of(scene: Scene, max_points: int) -> View:
    """Thin a scene for a page, and choose from where it is seen."""
    parts, mesh = [part.cloud for part in scene.points if len(part.cloud)], scene.mesh
    mesh = None if mesh is None or not len(mesh.faces) else thin_mesh(mesh, MAX_FACES)
    seen = [path.cloud.xyz for path in scene.paths]
    points: tuple[Points, ...] = ()
    if parts:
        cloud = join_clouds(parts) if len(parts) > 1 else parts[0]
        cloud = cloud.select(near_others(cloud.xyz))
        seen.append(cloud.xyz)
        thinned, of = thin_cloud(cloud, max_points), counted(len(cloud), "point", form=",")
        points = (Points(f"cloud ({len(thinned):,} of {of})", thinned),)
    elif mesh is not None:
        seen.append(mesh.vertices)
    xyz = np.concatenate(seen, dtype=np.float64)
    middle, half = (xyz.max(axis=0) + xyz.min(axis=0)) / 2, np.ptp(xyz, axis=0) / 2
    half = 1.02 * np.maximum(half, max(float(half.max()) * 0.02, 0.01))  # nothing is entirely flat
    unit = 1.0 / float(half.max())
    if scene.eye_m is None:
        eye, centre = ((place - middle) * unit for place in first_view(xyz, _HALF_VIEW))
    else:
        eye, centre = (np.asarray(scene.eye_m) - middle) * unit, _LOOK_AT
        # Seen from the position of a long lens, everything would be small in this wider view.
        eye *= min(1.0, _FARTHEST_EYE / max(float(np.linalg.norm(eye)), 1e-9))
    small = replace(scene, points=points, mesh=mesh)
    return View(small, np.stack([middle - half, middle + half]), eye, centre)


def plot(view: View) -> Json:
    """Return the ``data`` and ``layout`` that plotly.js draws.

    ``layout.meta`` lists the colourings of the cloud, the first trace: ``label``, ``legend``, and
    its ``marker``.
    """
    scene, data, colourings = view.scene, list[Json](), list[Json]()
    for by in known_colourings(scene.points) if scene.points else ():
        (rgb,), legend = colours(scene.points, by)
        colourings.append({"label": by, "legend": legend, "marker": _palette_scale(rgb)})
    for part in scene.points:
        marker = {"size": 1.6, "showscale": False, **colourings[0]["marker"]}
        look = {"mode": "markers", "hoverinfo": "skip", "marker": marker}
        data.append({"type": "scatter3d", "name": part.name, **look, **_xyz(part.cloud.xyz)})
    if scene.mesh is not None:
        data.append(_mesh_trace(scene.mesh, view.mesh_name, hidden=bool(data)))
    for path in scene.paths:
        rgb = _coloured(path.cloud.rgb, len(path.cloud))
        look = {"mode": "lines", "line": {"width": 6, **_line_colours(rgb)}}
        look["hovertemplate"] = "frame %{pointNumber}<br>x %{x:.5r} y %{y:.5r} z %{z:.5r} m"
        data.append({"type": "scatter3d", "name": path.name, **look, **_xyz(path.cloud.xyz)})
    box = dict(zip(_AXES, view.box.T.tolist(), strict=True))
    sides, eye, centre = (
        dict(zip("xyz", each.tolist(), strict=True)) for each in (view.sides, view.eye, view.centre)
    )
    shown: Json = {f"{name}axis": {**axis, "range": box[name]} for name, axis in _AXES.items()}
    shown |= {"aspectmode": "manual", "aspectratio": sides}
    shown |= {"camera": {"eye": eye, "center": centre}}
    return {"data": data, "layout": {**_LAYOUT, "scene": shown, "meta": colourings}}


def quantise_colours(rgb: UInt8) -> tuple[UInt8, UInt8]:
    """Return a palette of colours (N, 3): uint8 (P, 3), P <= 256, and uint8 (N,) indices in it."""
    if not len(rgb):
        return np.zeros((1, 3), dtype=np.uint8), np.zeros(0, dtype=np.uint8)
    image = Image.fromarray(rgb[None]).quantize(256, Image.Quantize.MEDIANCUT)
    palette = np.array(image.getpalette(), dtype=np.uint8).reshape(-1, 3)
    return palette, np.asarray(image)[0]


def _mesh_trace(mesh: TriangleMesh, name: str, *, hidden: bool) -> Json:
    # One colour per face, as palette indices cannot be interpolated.
    rgb = _coloured(mesh.rgb, len(mesh.vertices))[mesh.faces].mean(axis=1)
    colouring = _palette_scale(np.rint(rgb).astype(np.uint8))
    colouring |= {"intensity": colouring.pop("color"), "intensitymode": "cell"}
    return {
        "type": "mesh3d",
        "name": name,
        "hoverinfo": "skip",
        "showlegend": True,
        "showscale": False,
        "visible": "legendonly" if hidden else True,
        "lighting": {"ambient": 0.65, "diffuse": 0.5, "specular": 0.05},
        **_xyz(mesh.vertices),
        **{name: _packed(column) for name, column in zip("ijk", mesh.faces.T, strict=True)},
        **colouring,
    }


def _line_colours(rgb: UInt8) -> Json:
    """Return the colours of a path: one, which a legend shows, or one for each pose."""
    one = len(rgb) > 0 and (rgb == rgb[0]).all()
    return {"color": "rgb({},{},{})".format(*rgb[0].tolist())} if one else _palette_scale(rgb)


def _palette_scale(rgb: UInt8) -> Json:
    """Return a scale with one colour per palette entry, and the index of each point in it."""
    palette, index = quantise_colours(rgb)
    known = palette if len(palette) > 1 else np.repeat(palette, 2, axis=0)
    last = len(known) - 1
    scale = [[n / last, f"rgb({r},{g},{b})"] for n, (r, g, b) in enumerate(known.tolist())]
    return {"color": _packed(index), "colorscale": scale, "cmin": 0, "cmax": last}


def _xyz(points: NDArray[Any]) -> Json:
    return {n: _packed(x) for n, x in zip("xyz", points.astype(np.float32).T, strict=True)}


def _packed(values: NDArray[Any]) -> Json:
    """Return an array as plotly.js takes it."""
    data = base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
    return {"dtype": values.dtype.str[1:], "bdata": data}


def draw_still(view: View) -> bytes:
    """Draw what a view shows at first as a PNG file, as large as fits, transparent around it.

    Points, and corners of triangles, are squares, the near ones larger and upon the far ones; paths
    are upon all.
    """
    layers = _layers(view)
    parts = [_in_view(view, xyz, rgb) for _, xyz, rgb in layers]
    places = np.concatenate([place for place, _, _ in parts])
    low, extent = (places.min(axis=0), np.ptp(places, axis=0)) if len(places) else np.zeros((2, 2))
    zoom = float((_SIZE_PX / np.maximum(extent, 1.0)).min())
    columns, rows = (extent * zoom).astype(int) + _SQUARES_PX[1] + 1
    pixels = np.zeros((rows, columns, 4), np.uint8)
    for place, away, rgb in filter(lambda part: len(part[0]), parts):
        usual_px = math.sqrt(0.5 * rows * columns / len(rgb)) * np.median(away)
        sides = np.clip(usual_px / away, *_SQUARES_PX)
        within = [*np.ndindex(_SQUARES_PX[1], _SQUARES_PX[1])]
        covered = [np.flatnonzero(sides >= max(at) + 1) for at in within]
        # The near points come last, and of several values for a pixel the last one stays.
        point = np.concatenate(covered)
        order = np.argsort(point, kind="stable")
        column, row = (np.repeat(within, [*map(len, covered)], axis=0)[order]).T
        point = point[order]
        at_column, at_row = ((place - low) * zoom).astype(int)[point].T
        pixels[at_row + row, at_column + column, :3] = rgb[point]
        pixels[at_row + row, at_column + column, 3] = 255
    size = " by ".join(f"{side_m:.3g}" for side_m in np.ptp(view.box, axis=0))
    names = ", ".join(name for name, _, _ in layers)
    seen = f"View in 3-D of {names}, in a box of {size} m (x forward, y left, z up)"
    return style.pack_png(Image.fromarray(pixels), {style.SEEN: seen})


def _layers(view: View) -> list[tuple[str, NDArray[Any], UInt8]]:
    """Return names, places (N, 3) and colours (N, 3) of what is shown at first; paths come last."""
    scene, layers = view.scene, list[tuple[str, NDArray[Any], UInt8]]()
    for part in scene.points:
        (rgb,), _ = colours(scene.points, known_colourings(scene.points)[0])
        layers.append((part.name, part.cloud.xyz, rgb))
    if scene.mesh is not None and not layers:
        vertices = scene.mesh.vertices
        layers.append((view.mesh_name, vertices, _coloured(scene.mesh.rgb, len(vertices))))
    for path in scene.paths:
        if count := len(path.cloud):
            at = np.linspace(0, count - 1, _STEPS)
            xyz = [np.interp(at, np.arange(count), each) for each in path.cloud.xyz.T]
            own = _coloured(path.cloud.rgb, count)[np.rint(at).astype(np.int64)]
            layers.append((path.name, np.stack(xyz, axis=1), own))
    return layers


def _coloured(rgb: UInt8 | None, count: int) -> UInt8:
    return np.tile(np.array(_GREY, np.uint8), (count, 1)) if rgb is None else rgb


def _in_view(view: View, xyz: NDArray[Any], rgb: UInt8) -> tuple[Float64, Float64, UInt8]:
    """Return columns and rows (N, 2) of what is seen of points, how far away, and colours.

    The near come last.
    """
    ahead = (view.centre - view.eye) / np.linalg.norm(view.centre - view.eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= max(float(np.linalg.norm(right)), 1e-9)
    box = view.box
    rays = (xyz - box.mean(axis=0)) * view.sides / np.ptp(box, axis=0) - view.eye
    away, down = rays @ ahead, np.cross(ahead, right)
    focal_px = _SIZE_PX[1] / 2 / math.tan(_FIELD_RAD / 2)
    flat = np.stack([rays @ right, rays @ down], axis=1) / np.maximum(away, 1e-9)[:, None]
    place = _SIZE_PX / 2 + focal_px * flat
    seen = np.flatnonzero((away > 0) & (place >= 0).all(axis=1) & (place < _SIZE_PX).all(axis=1))
    order = seen[np.argsort(-away[seen], kind="stable")]
    return place[order], away[order], rgb[order]
