"""Steps of depth: what windows took across them is taken back, and what is doubtful says so."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from recon.core.values import Disparity, Reason, RectifiedPair
from recon.io.middlebury import stand_in_camera
from recon.stereo.kernels import filling
from recon.stereo.match.fill import vote_at_steps

HEIGHT, WIDTH, EDGE, REACH = 60, 120, 70, 5


def settled(values: np.ndarray, grey: np.ndarray) -> Disparity:
    pair = RectifiedPair(grey, grey, stand_in_camera(grey.shape[1], grey.shape[0]))
    seen = Disparity.from_values(values, confidence=0.9)
    with ThreadPoolExecutor(2) as pool:
        return vote_at_steps(pair, seen, REACH, pool)


def scene(fattened: int) -> tuple[np.ndarray, np.ndarray]:
    """A near half, whose disparity reaches some pixels beyond its edge, before a far one."""
    near = np.arange(WIDTH) < EDGE
    values = np.where(np.arange(WIDTH) < EDGE + fattened, 30.0, 10.0)
    grey = np.where(near, 60, 160).astype(np.uint8)
    return (np.tile(row, (HEIGHT, 1)) for row in (values.astype(np.float32), grey))


def test_what_reaches_beyond_an_edge_is_taken_back_and_nothing_else():
    values, grey = scene(fattened=4)
    found = settled(values, grey)
    beyond = np.zeros(values.shape, bool)
    beyond[:, EDGE + 1 : EDGE + 4] = True  # the first column is blurred into the near half
    assert (found.reason[beyond] == Reason.EDGE).all()
    assert found.valid[:, : EDGE - 1].all()
    assert found.valid[:, EDGE + 4 :].all()


def test_a_step_without_an_edge_of_the_image_keeps_its_sides_but_less_surely():
    values, _ = scene(fattened=0)
    found = settled(values, np.full(values.shape, 100, np.uint8))
    assert found.valid.all()
    beside, far = found.confidence[:, EDGE - 2 : EDGE + 2], found.confidence[:, : EDGE - 3 * REACH]
    np.testing.assert_array_equal(far, np.float32(0.9))
    assert (beside > 0).all()
    assert beside.max() < 0.8


def test_slanted_and_plain_surfaces_have_no_steps():
    across = np.tile(np.linspace(10, 40, WIDTH, dtype=np.float32), (HEIGHT, 1))
    found = settled(across, np.full(across.shape, 100, np.uint8))
    np.testing.assert_array_equal(found.values, across)
    np.testing.assert_array_equal(found.confidence, np.float32(0.9))


def mark_steps_reference(values: np.ndarray, reach: int, step_px: float) -> np.ndarray:
    marked = np.zeros(values.shape, np.uint8)
    for y, row in enumerate(values):
        known = np.flatnonzero(np.isfinite(row))
        for a, b in itertools.pairwise(known):
            if b - a <= 3 * reach and abs(row[b] - row[a]) > step_px:
                marked[y, max(a - reach + 1, 0) : b + reach] = 1
    return marked


def take_votes_reference(values, grey, alike, marked, vote):
    own, (height, width) = np.ones(values.shape, np.float32), values.shape
    offsets = np.arange(-(vote.radius // vote.stride), vote.radius // vote.stride + 1) * vote.stride
    for y, x in np.argwhere((marked > 0) & np.isfinite(values)):
        sums = np.zeros(3)
        for dy in offsets:
            for dx in offsets:
                v, u = y + dy, x + dx
                if not (0 <= v < height and 0 <= u < width) or np.isnan(values[v, u]):
                    continue
                apart = values[v, u] - values[y, x]
                limit = vote.same_px + vote.slope * max(abs(dy), abs(dx))
                side = 0 if apart > limit else 2 if apart < -limit else 1
                sums[side] += alike[abs(int(grey[v, u]) - int(grey[y, x]))]
        ratio = sums[1] / sums.sum()
        own[y, x] = ratio if sums[1] >= max(sums[0], sums[2]) else ratio - 1
    return own


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 12), st.integers(1, 3),
    st.integers(1, 3),
)  # fmt: skip
def test_kernels_are_their_references(seed, height, width, reach, stride):
    rng = np.random.default_rng(seed)
    values = rng.choice([1.0, 1.5, 4.0, 9.0, np.nan], (height, width)).astype(np.float32)
    grey = rng.integers(0, 256, values.shape, dtype=np.uint8)
    marked = np.zeros(values.shape, np.uint8)
    filling.mark_steps(values, reach, 1.0, marked)
    np.testing.assert_array_equal(marked, mark_steps_reference(values, reach, 1.0))
    alike = np.exp(np.arange(256) / -8.0).astype(np.float32)
    vote, own = filling.Vote(3 * reach, stride, 1.0, 0.05), np.empty(values.shape, np.float32)
    middle = height // 2
    for first, end in ((0, middle), (middle, height)):
        filling.take_votes(values, grey, alike, marked, vote, first, end, own)
    expected = take_votes_reference(values, grey, alike, marked, vote)
    sure = (
        np.abs(np.abs(own - np.round(own * 2) / 2)) > 1e-5
    )  # a constraint may fall to either side
    np.testing.assert_allclose(own[sure], expected[sure], atol=1e-5)
