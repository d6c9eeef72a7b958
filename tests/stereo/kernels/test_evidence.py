"""What speaks for a plane in a gap, in eight directions, beside a plain loop."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.stereo.kernels import filling


def nearest_reference(known, y, x, direction):
    down, right = filling.STEPS[direction]
    steps = 0
    while True:
        steps += 1
        v, u = y + steps * down, x + steps * right
        if not (0 <= v < known.shape[0] and 0 <= u < known.shape[1]):
            return filling.NOWHERE
        if known[v, u]:
            return steps


def weigh_reference(values, distances, plane, y, x, within_px):
    agree, against = [], 0
    for k, (down, right) in enumerate(filling.STEPS):
        steps = int(distances[k, y, x])
        rest = np.inf
        if steps != filling.NOWHERE:
            dy, dx = steps * down, steps * right
            there = plane[0, y, x] + plane[1, y, x] * dx + plane[2, y, x] * dy
            rest = values[y + dy, x + dx] - there
        agree.append(abs(rest) <= within_px)
        against += rest < -within_px
    around = "".join("x" if one else "." for one in agree * 2)
    gap = max(map(len, around.split("x")))
    return sum(agree), against, min(gap, filling.DIRECTIONS)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(1, 9))
def test_kernels_are_their_references(seed, height, width):
    rng = np.random.default_rng(seed)
    known = rng.random((height, width)) < 0.4
    values = np.where(known, rng.choice([3.0, 5.0, 9.0], known.shape), np.nan).astype(np.float32)
    distances = np.empty((filling.DIRECTIONS, *known.shape), np.uint16)
    for direction, of in enumerate(distances):
        filling.find_nearest(known, direction, of)
    for k, y, x in np.ndindex(distances.shape):
        assert distances[k, y, x] == nearest_reference(known, y, x, k)
    planes = rng.choice([4.5, np.nan], (3, *known.shape)).astype(np.float32)
    planes[1:] = 0.0
    wanted, found = rng.random(known.shape) < 0.8, np.empty((3, *known.shape), np.uint8)
    for rows in (range(height // 2), range(height // 2, height)):
        args = values, distances, planes, wanted, 1.0
        filling.weigh_planes(*args, rows.start, rows.stop, found)
    for y, x in np.ndindex(known.shape):
        asked = wanted[y, x] and np.isfinite(planes[0, y, x])
        none = (0, 0, filling.DIRECTIONS)
        expected = weigh_reference(values, distances, planes, y, x, 1.0) if asked else none
        assert tuple(found[:, y, x]) == expected
