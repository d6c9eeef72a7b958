"""Procedural materials: from a position on a surface to its colour (Lambertian albedo).

Ref: box-filtered pulse trains, Peachey in *Texturing and Modeling*, 3rd ed., ch. 2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from recon.core.values.arrays import Float64, Int32
from recon.street.kernels.surface import SurfaceHits, fractal_noise, lattice_values
from recon.street.shapes import Material, TriangleSoup

GAMMA: Final = 2.2  # exponent from display values to linear light
_OCTAVES: Final = 7
_ROUGHNESS: Final = 0.92  # amplitude of each octave relative to the next coarser one
ROAD_HALF_M: Final = 5.2
_LANE_HALF_M = 3.05
#: Of each grain: coarsest wavelength in metres, strength in the exponent of the brightness.
GRAIN: Final = {
    Material.PLAIN: (0.6, 0.5), Material.ASPHALT: (0.6, 0.5), Material.PAVING: (0.8, 0.4),
    Material.KERB: (0.5, 0.45), Material.PLASTER: (2.2, 0.30), Material.BRICK: (1.2, 0.45),
    Material.GLASS: (1.6, 0.9), Material.DOOR: (0.5, 0.35), Material.ROOF: (0.8, 0.5),
    Material.CAR_PAINT: (0.5, 0.09), Material.CAR_GLASS: (0.7, 0.09), Material.BARK: (0.25, 1.0),
    Material.LEAVES: (0.6, 2.0), Material.METAL: (0.3, 0.35), Material.GRASS: (0.7, 0.9),
    Material.POSTER: (0.35, 0.6), Material.WHITE: (1.0, 0.03), Material.MIRROR: (1.0, 0.0),
}  # fmt: skip
_WAVELENGTHS, _CONTRASTS = np.array([GRAIN[material] for material in Material]).T.copy()


@dataclass(frozen=True, eq=False)
class Patch:
    """Points of one material, the input of its recipe."""

    uv: Float64  # (N, 2), metres on the surface
    spread: Float64  # (N, 2), footprint of the pixel along u and v
    u: Float64  # (N,), the columns of both
    v: Float64
    du: Float64
    dv: Float64
    height_m: Float64  # (N,), above the road
    grain: Float64  # (N,), noise of mean 0
    rgb: Float64  # (N, 3), base colour as displayed
    part: Int32  # (N,), number of the object


Recipe = Callable[[Patch], Float64]


def albedo(soup: TriangleSoup, faces: Int32, hits: SurfaceHits, seed: int) -> Float64:
    """Return float64 (N, 3), diffuse colours in [0, 1], linear light, of points on ``faces``."""
    material = soup.material[faces]
    grain = fractal_noise(
        hits.xyz, hits.smear, hits.width, _WAVELENGTHS[material], _OCTAVES, _ROUGHNESS, seed
    )
    rgb: Float64 = soup.rgb[faces] ** GAMMA * np.exp(_CONTRASTS[material] * grain)[:, None]
    part = soup.part[faces]
    order = np.argsort(material, kind="stable")
    ends = np.searchsorted(material[order], np.arange(len(Material) + 1))
    for kind, recipe in RECIPES.items():
        which = order[ends[kind] : ends[kind + 1]]
        if len(which):
            uv, spread, height_m = hits.uv[which], hits.spread[which], hits.xyz[which, 2]
            columns = (uv[:, 0], uv[:, 1], spread[:, 0], spread[:, 1])
            own = (height_m, grain[which], rgb[which], part[which])
            rgb[which] = recipe(Patch(uv, spread, *columns, *own))
    return np.clip(rgb, 0.0, 1.0)


def _blend(rgb: Float64, paint: tuple[float, float, float], ratio: Float64) -> Float64:
    """Cover a fraction (N,) of each footprint with a display colour."""
    cover = ratio[:, None]
    return np.asarray(rgb * (1.0 - cover) + np.array(paint) ** GAMMA * cover)


def _variation(p: Patch, channel: int) -> Float64:
    """Return one random number in [-1, 1) per object."""
    return lattice_values(p.part, channel, 0, 11)


def _toned(
    p: Patch, tile: tuple[float, float], strength: float, seed: Any, bond: float = 0.0
) -> Float64:
    tone = tile_tone(p.uv, tile, p.spread, seed, bond)
    return np.asarray(p.rgb * (1.0 + strength * tone)[:, None])


def _asphalt(p: Patch) -> Float64:
    """Return tracks, patches, joints and worn markings; u is along the road, v to the left."""
    u, v, du, dv = p.u, p.v, p.du, p.dv
    tracks = sum(np.exp(-(((v - c) / 0.35) ** 2)) for c in (-2.3, -0.8, 0.8, 2.3))
    repairs = tile_tone(p.uv, (5.3, 2.1), p.spread, 0)
    rgb = p.rgb * (1.0 - 0.12 * np.asarray(tracks) + 0.16 * np.round(repairs * 0.8))[:, None]
    seam = v - 0.12 * np.sin(0.9 * u) - 0.05 * np.sin(3.1 * u)
    tar = both(stripe(seam, 0.35, 0.40, dv), stripe(seam, -3.5, -3.46, dv))
    across = u + 0.1 * np.sin(2.0 * v) + 0.04 * np.sin(7.0 * v)
    rgb = _blend(rgb, (0.16, 0.16, 0.17), 0.7 * both(tar, stripes(across, 11.3, 0.04, du)))
    dashes = stripes(u, 6.0, 3.0, du) * stripe(v, -0.07, 0.07, dv)
    edges = stripe(np.abs(v), _LANE_HALF_M, _LANE_HALF_M + 0.1, dv)
    bays = stripes(u, 6.0, 0.1, du) * stripe(np.abs(v), _LANE_HALF_M, ROAD_HALF_M, dv)
    gutter = stripe(np.abs(v), ROAD_HALF_M - 0.25, ROAD_HALF_M, dv)
    rgb = _blend(rgb, (0.42, 0.41, 0.39), 0.6 * gutter)
    worn = np.clip(0.75 + 0.5 * p.grain, 0.0, 0.95)
    return _blend(rgb, (0.85, 0.85, 0.83), worn * both(both(dashes, edges), bays))


def _paving(p: Patch) -> Float64:
    joints = tile_joints(p.uv, (0.6, 0.4), 0.016, p.spread, 0.5)
    return _blend(_toned(p, (0.6, 0.4), 0.16, 0, 0.5), (0.25, 0.24, 0.22), 0.75 * joints)


def _kerb(p: Patch) -> Float64:
    joints = stripes(p.u, 1.0, 0.02, p.du)
    return _blend(_toned(p, (1.0, 1.0), 0.12, 0), (0.2, 0.2, 0.2), 0.8 * joints)


def _roof(p: Patch) -> Float64:
    joints = stripes(p.v, 0.35, 0.05, p.dv)
    return _blend(_toned(p, (0.3, 0.35), 0.2, p.part, 0.5), (0.1, 0.08, 0.07), 0.6 * joints)


def _metal(p: Patch) -> Float64:
    return _blend(p.rgb, (0.75, 0.74, 0.7), 0.5 * stripes(p.v, 0.9, 0.05, p.dv))


def _weather(p: Patch) -> Float64:
    foot = np.exp(-np.maximum(p.height_m, 0.0) / 0.5)
    streaks = tile_tone(p.uv * [1.0, 0.0], (0.37, 1.0), p.spread * [1.0, 0.0], p.part)
    return np.asarray((1.0 - 0.3 * foot) * (1.0 + 0.045 * streaks))


def _plaster(p: Patch) -> Float64:
    return np.asarray(p.rgb * _weather(p)[:, None])


def _brick(p: Patch) -> Float64:
    tile = (0.25, 0.083)
    tone = 0.28 * tile_tone(p.uv, tile, p.spread, p.part, bond=0.5)
    tone += 0.07 * tile_tone(p.uv, (0.9, 0.4), p.spread, p.part + 1)
    rgb = p.rgb * ((1.0 + tone) * _weather(p))[:, None]
    return _blend(rgb, (0.62, 0.60, 0.56), 0.8 * tile_joints(p.uv, tile, 0.013, p.spread, 0.5))


def _glass(p: Patch) -> Float64:
    rgb = p.rgb * np.clip(1.0 + 0.5 * (p.v - 0.7), 0.5, 2.5)[:, None]
    curtain = (_variation(p, 1) > 0.1) * stripe(p.u % 1.1, 0.0, 0.36, p.du)
    folds = 0.5 + 0.25 * np.sin(p.u * 42.0) * np.exp(-((p.du / 0.06) ** 2))
    blind = 0.35 + 0.6 * _variation(p, 2)
    blind = stripe(p.v, 1.5 - blind, 9.0, p.dv) * (_variation(p, 3) > 0.2)
    rgb = _blend(rgb, (0.75, 0.72, 0.66), np.asarray(curtain * folds))
    return _blend(rgb, (0.66, 0.64, 0.58), 0.8 * np.asarray(blind))


def _door(p: Patch) -> Float64:
    u, v = p.u % 1.1, p.v
    frame = 1.0 - stripe(np.abs(u - 0.55), 0.08, 0.45, p.du) * (1.0 - stripes(v, 0.75, 0.14, p.dv))
    rgb = p.rgb * (0.7 + 0.45 * frame)[:, None]
    slot = stripe(u, 0.4, 0.7, p.du) * stripe(v, 1.02, 1.09, p.dv)
    return _blend(rgb, (0.8, 0.75, 0.5), slot)


def _car_paint(p: Patch) -> Float64:
    gaps = both(*(stripe(np.abs(p.u - x), 0.0, 0.012, p.du) for x in (-0.25, 0.80)))
    trim = stripe(p.v, 0.5, 0.56, p.dv)
    dirt = np.exp(-np.maximum(p.height_m - 0.2, 0.0) / 0.18)
    rgb = p.rgb * (1.0 - 0.35 * dirt)[:, None]
    return _blend(rgb, (0.06, 0.06, 0.06), 0.8 * both(gaps, trim))


def _car_glass(p: Patch) -> Float64:
    pillars = stripe(np.abs(p.u + 0.25), 0.0, 0.05, p.du)
    cover = both(pillars, stripe(p.v, 1.36, 9.0, p.dv))[:, None]
    dark = np.array([0.16, 0.18, 0.2]) ** GAMMA * np.exp(0.8 * p.grain)[:, None]
    dark = dark * (1.0 + 2.0 * np.clip(p.v - 1.0, 0.0, 0.5))[:, None]
    return np.asarray(dark * (1.0 - cover) + p.rgb * cover)


def _leaves(p: Patch) -> Float64:
    tint = np.clip(0.5 + 0.6 * p.grain, 0.0, 1.0)[:, None]
    return np.asarray(p.rgb * (tint * [1.25, 1.1, 0.7] + (1.0 - tint) * [0.7, 0.85, 0.9]))


def _poster(p: Patch) -> Float64:
    tones = [tile_tone(p.uv, (0.23, 0.31), p.spread, p.part + k) for k in (0, 1, 2)]
    rgb = p.rgb * (1.0 + 0.3 * tones[0][:, None] + 0.3 * np.stack(tones, axis=1))
    printed = lattice_values(np.floor(p.v / 0.11), p.part, 0, 3) > -0.3
    rgb = _blend(rgb, (0.12, 0.12, 0.14), 0.7 * (stripes(p.v, 0.11, 0.03, p.dv) * printed))
    return _blend(rgb, (0.88, 0.88, 0.86), 1.0 - stripe(p.u, 0.05, 50.0, p.du))


RECIPES: Final[dict[Material, Recipe]] = {
    Material.ASPHALT: _asphalt, Material.PAVING: _paving, Material.KERB: _kerb,
    Material.PLASTER: _plaster, Material.BRICK: _brick, Material.GLASS: _glass,
    Material.DOOR: _door, Material.ROOF: _roof, Material.CAR_PAINT: _car_paint,
    Material.CAR_GLASS: _car_glass, Material.LEAVES: _leaves, Material.METAL: _metal,
    Material.POSTER: _poster,
}  # fmt: skip


def sky_colour(directions: Float64, pixel: float, seed: int) -> Float64:
    """Return linear light (N, 3) of the sky, z up; ``pixel`` is the width of a pixel, radians."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    climb = np.clip(unit[:, 2:], 0.0, 1.0)
    haze = np.exp(-climb / 0.22)
    blue = np.array([0.36, 0.55, 0.83]) ** GAMMA
    white = np.array([0.86, 0.89, 0.93]) ** GAMMA
    flat, n = unit * [1.0, 1.0, 2.5], len(unit)
    width, wavelength = np.full(n, pixel), np.full(n, 0.4)
    clouds = fractal_noise(flat, np.zeros((n, 3)), width, wavelength, 6, 0.65, seed + 5)
    cover = np.clip(0.35 + 1.1 * clouds, 0.0, 1.0)[:, None]
    clear = blue + (white - blue) * haze
    return np.asarray(clear + (white - clear) * 0.85 * cover)


_NARROW = 1e-6


def stripe(x: Float64, low: float | Float64, high: float, spread: Float64) -> Float64:
    """Return the fraction (N,) of ``x ± spread / 2`` that lies between ``low`` and ``high``."""
    half = 0.5 * np.maximum(spread, _NARROW)
    inside = np.minimum(x + half, high) - np.maximum(x - half, low)
    return np.asarray(np.maximum(inside, 0.0) / (2.0 * half))


def stripes(x: Float64, period: float, width: float, spread: Float64) -> Float64:
    """Return the fraction (N,) of ``x ± spread / 2`` in stripes ``k·period + [0, width]``."""
    half = 0.5 * np.maximum(spread, _NARROW)

    def covered(t: Float64) -> Float64:
        whole = np.floor(t / period)
        return np.asarray(whole * width + np.minimum(t - whole * period, width))

    return np.asarray((covered(x + half) - covered(x - half)) / (2.0 * half))


def both(a: Float64, b: Float64) -> Float64:
    """Return the fraction covered by at least one of two independent patterns."""
    return np.asarray(1.0 - (1.0 - a) * (1.0 - b))


def tile_tone(
    uv: Float64, tile: tuple[float, float], spread: Float64, seed: Any, bond: float = 0.0
) -> Float64:
    """Return a random tone in [-1, 1) per tile, averaged if a pixel covers several.

    ``seed`` is the number of the object; ``bond`` the offset of rows in tiles (bricks: 0.5).
    """
    total = np.zeros(len(uv))
    for su, sv in ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25)):
        row = np.floor((uv[:, 1] + sv * spread[:, 1]) / tile[1])
        column = np.floor((uv[:, 0] + su * spread[:, 0]) / tile[0] + bond * (row % 2))
        total += lattice_values(column, row, seed, 7)
    # The mean of n tiles deviates by 1/sqrt(n) of what one tile does; four are sampled.
    several = np.maximum(spread[:, 0] / tile[0], 1.0) * np.maximum(spread[:, 1] / tile[1], 1.0)
    return np.asarray(0.25 * total / several)


def tile_joints(
    uv: Float64, tile: tuple[float, float], joint: float, spread: Float64, bond: float = 0.0
) -> Float64:
    """Return the fraction (N,) of the footprint covered by the joints between tiles."""
    rows = stripes(uv[:, 1], tile[1], joint, spread[:, 1])
    shift = bond * tile[0] * (np.floor(uv[:, 1] / tile[1]) % 2)
    return both(rows, stripes(uv[:, 0] + shift, tile[0], joint, spread[:, 0]))
