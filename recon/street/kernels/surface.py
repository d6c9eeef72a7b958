"""Where rays meet triangles, and the band-limited noise there: the grain of every surface.

Ref: Peachey, "Building Procedural Textures", in *Texturing and Modeling* (value noise, and
fading octaves that are finer than a pixel); Perlin, "Improving Noise", 2002 (quintic fade).
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import Float64, Int32, kernel

# Beyond this ratio of its sides a footprint is widened instead of lengthened.
MAX_STRETCH: Final = 24.0
_MIN_COSINE: Final = 1.0 / 400.0


class SurfaceTable(NamedTuple):
    """Per triangle, all that is linear in a point on it."""

    anchor: Float64  # (F, 3), a corner
    normal: Float64  # (F, 3), unit normal of the plane
    to_uv: Float64  # (F, 2, 3); surface coordinates are ``uv + to_uv @ (xyz - anchor)``
    uv: Float64  # (F, 2), at the anchor
    to_shading: Float64  # (F, 3, 3), the same for the shading normal
    shading: Float64  # (F, 3), at the anchor


class SurfaceHits(NamedTuple):
    """Points that rays met, with the footprint of the pixel on the surface."""

    xyz: Float64  # (N, 3), metres
    normal: Float64  # (N, 3), unit shading normal towards the viewer
    uv: Float64  # (N, 2), surface coordinates, metres
    width: Float64  # (N,), short side of the footprint, metres
    smear: Float64  # (N, 3), long side of the footprint, metres; 0 when seen straight on
    spread: Float64  # (N, 2), extent of the footprint along u and v


@kernel
def describe_hits(
    table: SurfaceTable, faces: Int32, origin: Float64, directions: Float64, pixel: float
) -> SurfaceHits:
    """Describe where rays of unit depth pierce their triangles; ``pixel`` is ``1 / focal_px``."""
    n = len(faces)
    xyz, normals, uvs = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 2))
    widths, smears, spreads = np.empty(n), np.empty((n, 3)), np.empty((n, 2))
    local = np.empty(3)
    for i in range(n):
        face = faces[i]
        normal, anchor, ray = table.normal[face], table.anchor[face], directions[i]
        along, height, length = 0.0, 0.0, 0.0
        for k in range(3):
            along += ray[k] * normal[k]
            height += (anchor[k] - origin[k]) * normal[k]
            length += ray[k] * ray[k]
        length = np.sqrt(length)
        depth = height / along
        cosine = along / length
        stretch = 1.0 / max(abs(cosine), _MIN_COSINE)
        width = depth * pixel * max(stretch / MAX_STRETCH, 1.0)
        stretch = min(stretch, MAX_STRETCH)
        # Only what exceeds the short side is a smear; the view's part in the plane has length sin.
        smear = width * np.sqrt(stretch * stretch - 1.0)
        smear /= max(np.sqrt(max(1.0 - cosine * cosine, 0.0)), 1e-9)
        widths[i] = width
        for k in range(3):
            xyz[i, k] = origin[k] + depth * ray[k]
            local[k] = xyz[i, k] - anchor[k]
            smears[i, k] = smear * (ray[k] / length - cosine * normal[k])
        size = 0.0
        for c in range(3):
            value = table.shading[face, c]
            for k in range(3):
                value += table.to_shading[face, c, k] * local[k]
            normals[i, c] = value
            size += value * value
        size = -np.sign(along) / np.sqrt(size)
        for c in range(3):
            normals[i, c] *= size
        for c in range(2):
            value, square, smeared = table.uv[face, c], 0.0, 0.0
            for k in range(3):
                gradient = table.to_uv[face, c, k]
                value += gradient * local[k]
                square += gradient * gradient
                smeared += gradient * smears[i, k]
            uvs[i, c] = value
            spreads[i, c] = np.sqrt(square * width * width + smeared * smeared)
    return SurfaceHits(xyz, normals, uvs, widths, smears, spreads)


MAX_TAPS = 8
# Large odd constants, one per axis, and the two multipliers of the murmur3 finaliser.
_X, _Y, _Z, _S = 0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93
_M1, _M2 = 0xFF51AFD7ED558CCD, 0xC4CEB9FE1A85EC53
_AX, _AY, _AZ, _AS = np.uint64(_X), np.uint64(_Y), np.uint64(_Z), np.uint64(_S)
_AM1, _AM2, _SHIFT, _TOP = np.uint64(_M1), np.uint64(_M2), np.uint64(33), np.uint64(12)
_UNIT = 2.0**-51


@kernel
def _mix(h: Any) -> Any:
    """Spread the bits of a 64-bit key and map it to [-1, 1)."""
    h = (h ^ (h >> _SHIFT)) * _AM1
    h = (h ^ (h >> _SHIFT)) * _AM2
    return np.float64(h >> _TOP) * _UNIT - 1.0


@kernel
def _value_noise(x: float, y: float, z: float, seed: Any) -> Any:
    """Return random values on the integer lattice, interpolated with quintic weights."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    tx, ty, tz = x - fx, y - fy, z - fz
    tx = tx * tx * tx * (tx * (tx * 6.0 - 15.0) + 10.0)
    ty = ty * ty * ty * (ty * (ty * 6.0 - 15.0) + 10.0)
    tz = tz * tz * tz * (tz * (tz * 6.0 - 15.0) + 10.0)
    x0 = np.uint64(np.int64(fx)) * _AX
    y0 = np.uint64(np.int64(fy)) * _AY
    z0 = np.uint64(np.int64(fz)) * _AZ + seed * _AS
    x1, y1, z1 = x0 + _AX, y0 + _AY, z0 + _AZ
    near = (_mix(x0 ^ y0 ^ z0) * (1.0 - tx) + _mix(x1 ^ y0 ^ z0) * tx) * (1.0 - ty)
    near += (_mix(x0 ^ y1 ^ z0) * (1.0 - tx) + _mix(x1 ^ y1 ^ z0) * tx) * ty
    far = (_mix(x0 ^ y0 ^ z1) * (1.0 - tx) + _mix(x1 ^ y0 ^ z1) * tx) * (1.0 - ty)
    far += (_mix(x0 ^ y1 ^ z1) * (1.0 - tx) + _mix(x1 ^ y1 ^ z1) * tx) * ty
    return near * (1.0 - tz) + far * tz


@kernel
def _octaves(
    x: float,
    y: float,
    z: float,
    width: float,
    wavelength: float,
    octaves: int,
    gain: float,
    seed: Any,
) -> float:
    """Sum of octaves at one point, those finer than two widths faded out."""
    total, amplitude = 0.0, 1.0
    for octave in range(octaves):
        # An orthogonal matrix per octave keeps the lattices from lining up with the walls.
        x, y, z = (
            (2.0 * x + 3.0 * y + 6.0 * z) / 7.0,
            (6.0 * x + 2.0 * y - 3.0 * z) / 7.0,
            (3.0 * x - 6.0 * y + 2.0 * z) / 7.0,
        )
        fade = min(wavelength / width - 1.0, 1.0)
        if fade <= 0.0:
            break
        scale = 1.0 / wavelength
        value = _value_noise(x * scale, y * scale, z * scale, seed + np.uint64(octave))
        total += amplitude * fade * value
        amplitude *= gain
        wavelength *= 0.5
    return total


@kernel
def fractal_noise(
    xyz: Float64,
    smear: Float64,
    width: Float64,
    wavelength: Float64,
    octaves: int,
    gain: float,
    seed: int,
) -> Float64:
    """Return fractal value noise (N,), averaged over the footprint of a pixel.

    The strip that a pixel covers is sampled along its long side (``smear``), each sample blurred by
    the short side (``width``) only: else roads lose their texture. ``wavelength`` is the lattice
    spacing of the coarsest octave; each other one has half of it and ``gain`` times the amplitude.
    The mean is 0, the standard deviation about 0.3.
    """
    out = np.empty(len(width))
    key = np.uint64(seed)
    power = 0.0
    for octave in range(octaves):
        power += gain ** (2 * octave)
    unit = 1.0 / np.sqrt(power)
    for i in range(len(width)):
        length = np.sqrt(smear[i, 0] ** 2 + smear[i, 1] ** 2 + smear[i, 2] ** 2)
        taps = int(min(max(np.ceil(length / width[i]), 1.0), float(MAX_TAPS)))
        blur = max(width[i], length / taps)
        total = 0.0
        for tap in range(taps):
            at = (tap + 0.5) / taps - 0.5
            total += _octaves(
                xyz[i, 0] + at * smear[i, 0],
                xyz[i, 1] + at * smear[i, 1],
                xyz[i, 2] + at * smear[i, 2],
                blur,
                wavelength[i],
                octaves,
                gain,
                key,
            )
        out[i] = unit * total / taps
    return out


def lattice_values(ix: Any, iy: Any, iz: Any, seed: int) -> Float64:
    """Return random values in [-1, 1) of integer lattice points of any shape, plain numpy."""
    x, y, z = (np.asarray(k).astype(np.int64).astype(np.uint64) for k in (ix, iy, iz))
    offset = np.uint64(seed * _S % 2**64)
    h = (x * _AX) ^ (y * _AY) ^ (z * _AZ + offset)
    h = (h ^ (h >> _SHIFT)) * _AM1
    h = (h ^ (h >> _SHIFT)) * _AM2
    return np.asarray((h >> _TOP).astype(np.float64) * _UNIT - 1.0)


def value_noise(xyz: Float64, seed: int) -> Float64:
    """Return one octave of `fractal_noise` with spacing 1 and no blur, in plain numpy."""
    base = np.floor(xyz)
    t = xyz - base
    weight = t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
    total = np.zeros(len(xyz))
    for corner in np.ndindex(2, 2, 2):
        step = np.array(corner)
        ratio = np.where(step == 1, weight, 1.0 - weight).prod(axis=1)
        ix, iy, iz = (base + step).astype(np.int64).T
        total += ratio * lattice_values(ix, iy, iz, seed)
    return total
