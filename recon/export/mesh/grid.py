"""The surface of one stereo pair, straight from the grid of its pixels.

A plane in space is a plane in column, row and inverse depth, too. So these are smoothed by planes
fitted to windows, and triangulated: the fewer triangles the flatter the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import cv2
import numpy as np

from recon.core.errors import MeshingError
from recon.core.values import PointCloud, RectifiedCamera, TriangleMesh
from recon.core.values.arrays import Bool, Float64, Int32, Int64
from recon.export.mesh.cut import components, meeting_sides, renumbered, vertex_normals
from recon.export.mesh.poisson import MeshSettings, simplified, usable

_SQUARE: Final = 64
"""Grid steps along the legs of the largest triangles; a power of two."""

_RADIUS: Final = 5
"""Half the width of the windows that planes are fitted to, grid steps: that of a matcher's window,
in which the errors of disparities are alike, and as much again."""

_EDGE_SIGMAS: Final = 3.0  # a step of so many standard deviations between neighbours is an edge
_MOST_SIGMAS: Final = 0.5  # a triangle may be off by so many
_MOST_CHANGE: Final = 0.1
"""Of the depth within a triangle, for each pixel of a grid step: a surface that changes by as much
is seen along itself, at 700 px of focal length to less than a degree."""
_LEAST_SIGMA_PX: Final = 1 / 64  # disparities are rarely written more finely
_LEAST_SPREAD: Final = 1e-6  # of coordinates in a window, square steps: next to nothing


@dataclass(frozen=True, eq=False)
class _Grid:
    """A cloud, sorted into the pixels that its points come from; arrays (R, C)."""

    point: Int32  # row of the cloud; -1 = none
    disparity: Float64  # focal length times baseline by depth, px
    sigma: Float64  # its standard deviation, px
    right: Float64  # slope of the disparity to the right, px
    down: Float64  # and down
    u: Float64  # (C,), column from the principal point, px
    v: Float64  # (R,), row from it

    @property
    def valid(self) -> Bool:
        return np.asarray(self.point >= 0)

    @cached_property
    def changes(self) -> Float64:
        """(R, C), logarithm of the disparity, in units of the largest change; NaN = no point."""
        known = np.where(self.valid, self.disparity, np.nan)
        return np.asarray(np.log(known) / (self.step_px * np.log1p(_MOST_CHANGE)))

    @property
    def step_px(self) -> float:
        return float(self.u[1] - self.u[0])


def mesh_grid(cloud: PointCloud, camera: RectifiedCamera, settings: MeshSettings) -> TriangleMesh:
    """Triangulate the surface that one stereo pair sees.

    Args:
        cloud: At most one point of each pixel, in camera axes, as of `FrameReconstructor`.
        camera: Saw it.
        settings: Of `min_component_faces`: a pixel counts as two. `pair_solid_m` closes the mesh.

    Returns:
        A manifold mesh in camera axes, with unit normals towards the camera, and colours if the
        cloud has any. No triangle is across a step of disparity, and within none the depth changes
        by more than a tenth (a fifth in a cloud of every second pixel), before ``target_faces``.

    Raises:
        MeshingError: There are too few points, or none next to one another.

    Ref: Evans, Kirkpatrick & Townsend, "Right-triangulated irregular networks", Algorithmica 2001.
    """
    cloud = usable(cloud.select(cloud.xyz[:, 2] > 0))
    grid = _sorted(cloud, camera)
    # Smoothed twice: disparities that are far off the first time hardly count the second.
    first = _fit_planes(grid, np.ones(grid.point.shape))
    off = (grid.disparity - first.disparity) / first.sigma
    grid = _fit_planes(grid, np.asarray(1 / (1 + off**2)))
    edges = _edges(grid)
    pixels, width = _triangles(_errors(grid, edges)), grid.point.shape[1]
    # Those with points at their corners, and no edge or change between them.
    pixels = pixels[np.ptp(grid.changes.ravel()[pixels], axis=1) <= 1]  # NaN without a point
    right = np.pad(edges[0], ((0, 0), (0, 1))).ravel()
    down = np.pad(edges[1], ((0, 1), (0, 0))).ravel()
    kept = np.ones(len(pixels), np.bool_)
    for end in pixels.T[:2]:
        low, way = np.minimum(end, pixels[:, 2]), np.abs(end - pixels[:, 2])
        kept &= ~((way == 1) & right[low]) & ~((way == width) & down[low])
    place, faces = _manifold(pixels[kept], settings.min_component_faces, width)
    row, column = np.divmod(place, width)
    z = camera.focal_px * camera.baseline_m / grid.disparity[row, column]
    x, y = (k * z / camera.focal_px for k in (grid.u[column], grid.v[row]))
    vertices = np.stack([x, y, z], axis=1).astype(np.float32)
    rgb = None if cloud.rgb is None else cloud.rgb[grid.point[row, column]]
    mesh = TriangleMesh(vertices, faces, vertex_normals(vertices, faces), rgb)
    if settings.pair_solid_m is not None:
        return closed_behind(mesh, settings.pair_solid_m)
    return simplified(mesh, settings)


def _sorted(cloud: PointCloud, camera: RectifiedCamera) -> _Grid:
    """Sort the points of a cloud into their pixels, of which it may have every n-th."""
    z = cloud.xyz[:, 2].astype(np.float64)
    u, v = (camera.focal_px * cloud.xyz[:, k] / z for k in (0, 1))
    column, row = (np.rint(k).astype(np.int64) for k in (u + camera.cx_px, v + camera.cy_px))
    first_u, first_v = int(column.min()), int(row.min())
    column, row = column - first_u, row - first_v
    step = max(1, int(np.gcd(np.gcd.reduce(column), np.gcd.reduce(row))))
    column, row = column // step, row // step
    # The grid is padded to whole squares.
    height, width = (_SQUARE * -(-int(k.max()) // _SQUARE) + 1 for k in (row, column))
    point = np.full((height, width), -1, np.int32)
    point[row, column] = np.arange(len(cloud), dtype=np.int32)
    fb = camera.focal_px * camera.baseline_m
    disparity, sigma, flat = np.zeros((3, height, width))
    disparity[row, column] = fb / z
    if cloud.sigma_m is not None:
        sigma[row, column] = fb / z**2 * cloud.sigma_m
    across, below = (step * np.arange(count, dtype=np.float64) for count in (width, height))
    across, below = across + (first_u - camera.cx_px), below + (first_v - camera.cy_px)
    return _Grid(point, disparity, sigma, flat, flat, across, below)


def _fit_planes(grid: _Grid, trust: Float64) -> _Grid:
    """Fit a plane to each window, and take the mean of those around a pixel.

    Windows count by how well a plane fits: those across an edge for next to nothing.

    Ref: He, Sun & Tang, "Guided image filtering", PAMI 2013, with coordinates as the guide.
    """
    d, valid = grid.disparity, grid.valid
    y, x = (k.astype(np.float64) for k in np.indices(valid.shape))
    known = valid & (grid.sigma > 0)
    usual = np.median(grid.sigma[known]) if known.any() else 1.0
    sigma = np.maximum(np.where(known, grid.sigma, usual), _LEAST_SIGMA_PX)
    weight, count = np.asarray(trust * valid / sigma**2), np.rint(_window(valid.astype(np.float64)))
    total, count = np.where(count > 0, _window(weight), 1.0), np.maximum(count, 1)
    mean_x, mean_y, mean_d = (_window(weight * k) / total for k in (x, y, d))
    xx, xy, xd = (_window(weight * x * k) / total for k in (x, y, d))
    yy, yd = (_window(weight * y * k) / total for k in (y, d))
    dd = _window(weight * d * d) / total
    # A window with a single row or column of points has no slope across it.
    xx, yy = (a - b * b + _LEAST_SPREAD for a, b in ((xx, mean_x), (yy, mean_y)))
    xy, xd, yd = xy - mean_x * mean_y, xd - mean_x * mean_d, yd - mean_y * mean_d
    right, down = (
        (a * b - c * xy) / (xx * yy - xy * xy) for a, b, c in ((xd, yy, yd), (yd, xx, xd))
    )
    misfit = np.maximum(dd - mean_d**2 - right * xd - down * yd, 0) * total / count
    if not known.any():
        # Nothing says how noisy the disparities are, but how they scatter.
        sigma = np.full(valid.shape, max(np.sqrt(np.median(misfit[valid])), _LEAST_SIGMA_PX))
        misfit /= sigma**2
    # Between points that a plane explains to within their noise, it holds for those missing, too.
    filled = valid | ((count > 0.5 * (2 * _RADIUS + 1) ** 2) & (misfit < 1))
    ratio = np.asarray(filled / (1.0 + misfit) ** 2)
    offset = mean_d - right * mean_x - down * mean_y
    total = np.where(filled, _window(ratio), 1.0)
    right, down, offset = (_window(ratio * k) / total for k in (right, down, offset))
    smooth = right * x + down * y + offset
    return replace(
        grid,
        point=np.where(filled & (smooth > 0), _nearest(grid.point), -1),
        disparity=smooth,
        sigma=sigma,
        right=right,
        down=down,
    )


def _nearest(point: Int32) -> Int32:
    missing = (point < 0).astype(np.uint8)
    kind = cv2.DIST_LABEL_PIXEL
    label = cv2.distanceTransformWithLabels(missing, cv2.DIST_L2, 3, labelType=kind)[1]
    numbers = np.zeros(label.max() + 1, np.int32)
    numbers[label[point >= 0]] = point[point >= 0]
    return np.asarray(numbers[label], np.int32)


def _window(values: Float64) -> Float64:
    size = (2 * _RADIUS + 1, 2 * _RADIUS + 1)
    border = cv2.BORDER_CONSTANT
    summed = cv2.boxFilter(values, cv2.CV_64F, size, normalize=False, borderType=border)
    return np.asarray(summed, np.float64)


def _edges(grid: _Grid) -> tuple[Bool, Bool]:
    """Return bool (R, C - 1) and (R - 1, C): what no triangle may cross between neighbours.

    One of them has no point, neither lies on the plane of the other, or the depth changes too much.
    On a plane at h baselines from the camera disparities change by at most 1 / h pixels per pixel:
    two are a step that matching has blurred; one to the right hides itself from the right camera.
    """

    def between(d: Float64, slope: Float64, sigma: Float64, changes: Float64) -> Bool:
        off = np.minimum(*(np.abs(np.diff(d) - k) for k in (slope[:, :-1], slope[:, 1:])))
        edge = off > _EDGE_SIGMAS * np.hypot(sigma[:, :-1], sigma[:, 1:])
        edge |= np.abs(np.diff(d)) >= 2 * grid.step_px
        return np.asarray(edge | ~(np.abs(np.diff(changes)) <= 1))  # nor where there is none

    right = between(grid.disparity, grid.right, grid.sigma, grid.changes)
    right |= np.diff(grid.disparity) >= grid.step_px
    return right, between(grid.disparity.T, grid.down.T, grid.sigma.T, grid.changes.T).T


def _errors(grid: _Grid, edges: tuple[Bool, Bool]) -> Float64:
    """Return (R, C): by how many sigmas triangles are off that are not split at a pixel.

    A triangle is split in the middle of its longest side, and with it its neighbour there. What is
    off in one of the parts counts for the whole. It is always split where the depth changes too
    much within.
    """
    # Beside an edge of a surface triangles must be smallest; they have diagonal sides, too.
    valid, torn = grid.valid, np.zeros(grid.valid.shape, np.uint8)
    right, down = edges[0] & (valid[:, :-1] | valid[:, 1:]), edges[1] & (valid[:-1] | valid[1:])
    torn[:, :-1] |= right
    torn[:, 1:] |= right
    torn[:-1] |= down
    torn[1:] |= down
    error = np.where(cv2.dilate(torn, np.ones((3, 3), np.uint8)) > 0, np.inf, 0.0)
    size = 2
    while size <= _SQUARE:
        for view in (np.asarray, np.transpose):
            _add_sides(view(error), view(grid.disparity), view(grid.sigma), size)
            _split_sides(view(error), view(grid.changes), size)
        _add_middles(error, grid.disparity, grid.sigma, size)
        corners = [grid.changes[rows, columns] for rows, columns in _corners(size)]
        error[size // 2 :: size, size // 2 :: size][_span(corners) > 1] = np.inf
        size *= 2
    return error


def _add_sides(error: Float64, d: Float64, sigma: Float64, size: int) -> None:
    """Add the errors in the middles of the upper and lower sides of squares of a size."""
    half, quarter = size // 2, size // 4
    middle = (slice(None, None, size), slice(half, None, size))
    straight = 0.5 * (d[::size, :-1:size] + d[::size, size::size])
    here = error[middle]
    np.maximum(here, np.abs(straight - d[middle]) / sigma[middle], out=here)
    if quarter:
        inner = error[quarter::half, quarter::half]
        inner = np.maximum(inner[:, ::2], inner[:, 1::2])
        np.maximum(here[:-1], inner[::2], out=here[:-1])
        np.maximum(here[1:], inner[1::2], out=here[1:])


def _split_sides(error: Float64, changes: Float64, size: int) -> None:
    """Split the triangles at the same sides within which the depth changes too much."""
    half = size // 2
    ends, apex = (changes[::size, :-1:size], changes[::size, size::size]), changes[half::size]
    apexes = np.pad(apex[:, half::size], ((1, 1), (0, 0)), constant_values=np.nan)
    error[::size, half::size][_span([*ends, apexes[1:], apexes[:-1]]) > 1] = np.inf


def _span(values: Sequence[Float64]) -> Float64:
    """Return by how much values differ, place by place, of those that are known."""
    return np.asarray(np.fmax.reduce(values) - np.fmin.reduce(values))


def _add_middles(error: Float64, d: Float64, sigma: Float64, size: int) -> None:
    """Add the errors in the middles of squares of a size, which lie on their diagonals."""
    half = size // 2
    middle = (slice(half, None, size), slice(half, None, size))
    a, b, c, e = (d[rows, columns] for rows, columns in _corners(size))
    straight = 0.5 * np.where(_falling(a.shape), a + e, b + c)
    here = error[middle]
    np.maximum(here, np.abs(straight - d[middle]) / sigma[middle], out=here)
    for side in (error[:-1:size, half::size], error[size::size, half::size]):
        np.maximum(here, side, out=here)
    for side in (error[half::size, :-1:size], error[half::size, size::size]):
        np.maximum(here, side, out=here)


def _corners(size: int) -> list[tuple[slice, slice]]:
    """Upper left, upper right, lower left and lower right corners of all squares of a size."""
    low, high = slice(None, -1, size), slice(size, None, size)
    return [(low, low), (low, high), (high, low), (high, high)]


def _falling(shape: tuple[int, ...]) -> Bool:
    """Return which squares are cut from upper left to lower right; others the other way."""
    row, column = np.indices(shape)
    return np.asarray((row + column) % 2 == 0)


def _triangles(error: Float64) -> Int64:
    """Return (F, 3) pixels: ends of the longest side, and the corner at the right angle."""
    pixel = np.arange(error.size).reshape(error.shape)
    a, b, c, e = (pixel[rows, columns] for rows, columns in _corners(_SQUARE))
    falling = _falling(a.shape)
    one = np.where(falling, [a, e, b], [b, c, e]).reshape(3, -1)
    other = np.where(falling, [e, a, c], [c, b, a]).reshape(3, -1)
    open_, done, error = np.concatenate([one, other], axis=1), [], error.ravel()
    for _ in range(2 * int(np.log2(_SQUARE))):
        first, last, corner = open_
        middle = (first + last) // 2
        split = error[middle] > _MOST_SIGMAS
        done.append(open_[:, ~split])
        first, last, corner, middle = (k[split] for k in (first, last, corner, middle))
        halves = ([corner, first, middle], [last, corner, middle])
        open_ = np.concatenate([np.stack(half) for half in halves], axis=1)
    return np.asarray(np.concatenate([*done, open_], axis=1).T, np.int64)


def _manifold(faces: Int64, least: int, width: int) -> tuple[Int64, Int32]:
    """Number the vertices of triangles (F, 3) of pixels anew: return their pixels, and faces.

    Where surfaces touch in a pixel alone, each has a vertex of its own. Those with an area of less
    than ``least`` half pixels are left out.
    """
    count = len(faces)
    pairs = meeting_sides(faces)
    one, other = pairs.T
    following = np.arange(3 * count).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    # Two triangles run along a side in opposite directions.
    links = np.stack([np.append(one, following[one]), np.append(following[other], other)], axis=1)
    surface = components(pairs // 3, count)
    row, column = np.divmod(faces, width)
    area = np.abs(
        (row[:, 0] - row[:, 2]) * (column[:, 1] - column[:, 2])
        - (row[:, 1] - row[:, 2]) * (column[:, 0] - column[:, 2])
    )
    kept = np.bincount(surface, area)[surface] >= least if count else np.zeros(0, np.bool_)
    if not kept.any():
        hint = "lower mesh.min_component_faces, or filter less"
        raise MeshingError("no surface: hardly any pixels with a depth are neighbours", hint=hint)
    corner = components(links, 3 * count).reshape(-1, 3)
    pixel = np.zeros(corner.max() + 1, np.int64)
    pixel[corner] = faces
    used, numbered = renumbered(corner[kept])
    return pixel[used], numbered


_LEAST_THICKNESS: Final = 1e-5  # of the depth; coordinates are exact to less than a hundredth of it
_APART: Final = 0.05  # of the way to the middle of its triangles, that a corner moves off another


def closed_behind(mesh: TriangleMesh, thickness_m: float) -> TriangleMesh:
    """Close the surface that a camera sees, at a thickness behind it.

    Each vertex is repeated on its ray, farther by the thickness in depth; walls along all edges of
    the surface, those of holes too, join both. No two rays meet, so that no part of the body is in
    another, nor are bodies of surfaces that lie one behind the other.

    Args:
        mesh: A manifold mesh in camera axes, of which a ray meets one triangle at most. Surfaces
            that touch in a vertex have one each, which are moved apart by a part of a pixel.
        thickness_m: Above 0; `MeshingError` if it is lost in the precision of the coordinates.

    Returns:
        A watertight mesh, with unit normals outwards; what is behind has the colours before it.
    """
    least_m = _LEAST_THICKNESS * float(mesh.vertices[:, 2].max())
    if thickness_m < least_m:
        what, expected = "the solid is too thin for its distance", f"at least {least_m:.3g} m"
        hint = "raise mesh.pair_solid_m"
        raise MeshingError(what, got=f"{thickness_m:g} m", expected=expected, hint=hint)
    # No two vertices may be in one place: else programs join them again.
    _, place, count = np.unique(mesh.vertices, axis=0, return_inverse=True, return_counts=True)
    middles = mesh.vertices[mesh.faces].mean(axis=1, dtype=np.float64)
    corner, face = mesh.faces.ravel(), np.repeat(np.arange(len(mesh.faces)), 3)
    number = np.maximum(np.bincount(corner, minlength=len(mesh.vertices)), 1)
    inside = [np.bincount(corner, axis[face], len(mesh.vertices)) / number for axis in middles.T]
    moved = mesh.vertices + _APART * (np.stack(inside, axis=1) - mesh.vertices)
    shared = count[place.ravel()] > 1
    front = np.where(shared[:, None], moved, mesh.vertices).astype(np.float32)
    back = front * (1 + thickness_m / front[:, 2:].astype(np.float64))
    vertices = np.concatenate([front, back]).astype(np.float32)
    # The edges that one triangle alone has, in its direction.
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    ends = np.sort(edges, axis=1)
    _, first, count = np.unique(ends, axis=0, return_index=True, return_counts=True)
    behind, edges = mesh.faces + len(front), edges[first[count == 1]]
    (a, b), (c, d) = edges.T, edges.T + len(front)
    walls = np.concatenate([np.stack([b, a, c], axis=1), np.stack([b, c, d], axis=1)])
    faces = np.concatenate([mesh.faces, behind[:, ::-1], walls]).astype(np.int32)
    rgb = None if mesh.rgb is None else np.concatenate([mesh.rgb, mesh.rgb])
    return TriangleMesh(vertices, faces, vertex_normals(vertices, faces), rgb)
