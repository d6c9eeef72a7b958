"""From the `Minima` of any search to disparities: checks, sub-pixel fit, confidence and sigma."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from recon.core.kernels.compiled import Bool, Float32, Int32, UInt8, UInt16, kernel
from recon.stereo.kernels.minima import NO_COST, Minima

# The codes of `recon.core.values.Reason`; a test holds them equal.
VALID, LOW_TEXTURE, AMBIGUOUS, LEFT_RIGHT, OCCLUDED, OUT_OF_RANGE, BORDER = range(7)
SIGMA_LARGEST_PX: Final = 2.0  # standard deviation at a flat minimum; none is larger
WRONG_PX: Final = 1.0  # error from which a disparity counts as wrong; the least of a wrong one
ODDS: Final = 2.2  # of being right at margin 1 and a standard deviation of 1 px


class Rules(NamedTuple):
    """Thresholds of the checks, and what costs mean."""

    ndisp: int  # number of candidates
    minimum: int  # disparity of candidate 0, pixels
    texture: float  # least texture of a pixel, in the unit of the texture given
    uniqueness: int  # by how many per cent the second best cost must exceed the best
    left_right: int  # largest difference between the two views, candidates; negative = unchecked
    window_pixels: int  # number of pixels that a cost sums up
    sigma_floor_px: float  # smallest standard deviation
    odds: float = ODDS  # odds that a pixel of margin 1 and a standard deviation of 1 px is right
    fit: bool = True  # whether the minimum is placed between whole disparities


class Refined(NamedTuple):
    """Disparities, as in `recon.core.values.Disparity`, all (H, W)."""

    values: Float32  # pixels; NaN = none
    confidence: Float32  # float32 in [0, 1]
    sigma_px: Float32  # float32; NaN = none
    reason: UInt8  # uint8


REFINED_BYTES: Final = 13  # what a pixel of `Refined` takes


def refined_in(memory: UInt8, height: int, width: int) -> Refined:
    """Arrays for `refine_minima` to write to, in memory of `REFINED_BYTES` for each pixel."""
    reason = memory[12 * height * width :].reshape(height, width)
    floats = memory[: 12 * height * width].view(np.float32)
    values, confidence, sigma_px = floats.reshape(3, height, width)
    return Refined(values, confidence, sigma_px, reason)


@kernel
def refine_minima(
    minima: Minima, texture: Float32, rules: Rules, first: int, end: int, refined: Refined
) -> None:
    """Check the minima of rows ``first`` to ``end - 1``, and refine those that pass.

    The first of these that applies is the reason of a pixel: no image (``texture``, which is that
    of these rows, is NaN) or no candidate, or one that ends at the border of the right image
    (BORDER); too little texture (LOW_TEXTURE); the minimum at an end of what was searched
    (OUT_OF_RANGE); the right view disagrees, and none of its pixels is matched here (OCCLUDED) or
    one is (LEFT_RIGHT); a second best that is too good (AMBIGUOUS).

    The sub-pixel offset is that of two equally steep lines, the shape of a sum of absolute
    differences. The standard deviation is that of a displacement
    estimated from N pixels with gradient g and noise n, here in its least-absolute form,
    ``pi/2 · mean|n| / (mean|g| · sqrt(N))``; the cost at the vertex of the lines is N·mean|n|,
    their slope is N·mean|g|. A floor is added in quadrature for what the model leaves out.

    The confidence is the probability that the disparity is off by no more than 1 px. Its odds grow
    with the margin ``m = (second - best) / (N + best)``, the distance of the two costs in units of
    the noise (one grey level added), and fall with the standard deviation: they are
    ``odds · sqrt(m / sigma³)``. The powers are rounded from a logistic regression on Middlebury
    scenes and the factor is fitted to them (`docs/evaluation.md` has the scenes held out).

    The standard deviation returned is that of a mixture of right and wrong disparities: its square
    is ``c·sigma² + (1 - c)·max(sigma, WRONG_PX)²``. Noise alone explains the errors on smooth
    surfaces; that windows across depth steps are often wrong only shows in the confidence.

    Ref: H. Hirschmüller, "Stereo processing by semiglobal matching and mutual information",
    PAMI 30, 2008, section 2.6 (occluded or mismatched); M. Shimizu, M. Okutomi, "Sub-pixel
    estimation error cancellation on area-based matching", IJCV 63, 2005 (equiangular fit);
    L. Matthies, "Stereo vision for planetary rovers: stochastic modeling to near real-time
    implementation", IJCV 8, 1992 (variance).
    """
    width = minima.winner.shape[1]
    # Whether a pixel of the right view chose each column; one more column at either side.
    chosen = np.empty(width + 2, np.uint8)
    apart = np.empty(width, np.int32)
    for y in range(first, end):
        _mark_chosen(minima.right_winner[y], rules, chosen)
        _compare_views(minima.winner[y], minima.right_winner[y], rules, apart)
        _judge(minima, texture[y - first], chosen, apart, rules, y, refined.reason[y])
        _measure(minima, rules, y, refined)


@kernel
def reject(mask: Bool, code: int, refined: Refined) -> None:
    """Invalidate the pixels of a mask (H, W), in place; ``code`` becomes their reason."""
    height, width = mask.shape
    for y in range(height):
        for x in range(width):
            if mask[y, x]:
                refined.values[y, x] = refined.sigma_px[y, x] = np.float32(np.nan)
                refined.confidence[y, x], refined.reason[y, x] = np.float32(0), np.uint8(code)


@kernel
def _mark_chosen(right_winner: UInt16, rules: Rules, chosen: UInt8) -> None:
    """Mark the columns of the left view where a pixel of the right view has its best match."""
    width = right_winner.size
    chosen[:] = 0
    for x_right in range(width):
        x = x_right + rules.minimum + np.int64(right_winner[x_right])
        if right_winner[x_right] != rules.ndisp and -1 <= x <= width:
            chosen[x + 1] = 1


@kernel
def _compare_views(winner: UInt16, right_winner: UInt16, rules: Rules, apart: Int32) -> None:
    """Write by how many candidates the right view disagrees with each winner; -1 = no winner."""
    for x in range(winner.size):
        k = np.int64(winner[x])
        apart[x] = abs(right_winner[x - rules.minimum - k] - k) if k < rules.ndisp else -1


@kernel
def _judge(
    minima: Minima,
    texture: Float32,
    chosen: UInt8,
    apart: Int32,
    rules: Rules,
    y: int,
    reason: UInt8,
) -> None:
    """Write the reasons of one row; without branches, so the first reason is selected last."""
    winner, best_cost, cost_before = minima.winner[y], minima.costs[0, y], minima.costs[1, y]
    cost_after, second_cost = minima.costs[2, y], minima.costs[3, y]
    to_left, to_right = chosen, chosen[2:]
    middle = chosen[1:]
    ndisp, last = np.uint16(rules.ndisp), np.uint16(rules.ndisp - 1)
    largest = np.int32(rules.left_right if rules.left_right >= 0 else rules.ndisp)
    unique = np.int32(rules.uniqueness + 100 if rules.uniqueness > 0 else 0)
    least_texture = np.float32(rules.texture)
    for x in range(winner.size):
        close = np.int32(second_cost[x]) * np.int32(100) <= np.int32(best_cost[x]) * unique
        code = np.uint8(AMBIGUOUS) if close and unique > 0 else np.uint8(VALID)
        # On a slanted surface that is wider in the left view matches leave gaps: neighbours count.
        seen = (to_left[x] | middle[x] | to_right[x]) != 0
        differs = np.uint8(LEFT_RIGHT) if seen else np.uint8(OCCLUDED)
        code = differs if apart[x] > largest else code
        place = x - rules.minimum - np.int32(winner[x])
        inside = place > 0 and place < winner.size - 1
        at_end = winner[x] == 0 or winner[x] == last or inside
        ends = np.uint8(OUT_OF_RANGE) if at_end else np.uint8(BORDER)
        code = ends if max(cost_before[x], cost_after[x]) == NO_COST else code
        code = np.uint8(LOW_TEXTURE) if texture[x] < least_texture else code
        nothing = winner[x] == ndisp or np.isnan(texture[x])
        reason[x] = np.uint8(BORDER) if nothing else code


@kernel(error_model="numpy")
def _measure(minima: Minima, rules: Rules, y: int, refined: Refined) -> None:
    """Write disparity, standard deviation and confidence of one row.

    All pixels are computed and invalid ones overwritten: a loop without branches and in float32
    alone is vectorised. So it needs numpy's error model, which does not check for division by zero.
    """
    winner, minimum = minima.winner[y], np.float32(rules.minimum)
    best_cost, cost_before = minima.costs[0, y], minima.costs[1, y]
    cost_after, second_cost = minima.costs[2, y], minima.costs[3, y]
    values, confidences, sigmas = refined.values[y], refined.confidence[y], refined.sigma_px[y]
    reasons = refined.reason[y]
    zero, half, one = np.float32(0), np.float32(0.5), np.float32(1)
    largest, nan = np.float32(SIGMA_LARGEST_PX), np.float32(np.nan)
    variance_floor = np.float32(rules.sigma_floor_px) * np.float32(rules.sigma_floor_px)
    pixels, odds_of_one = np.float32(rules.window_pixels), np.float32(rules.odds)
    noise_of_one = np.float32(0.5 * np.pi / np.sqrt(rules.window_pixels))
    for x in range(winner.size):
        best, second = np.float32(best_cost[x]), np.float32(second_cost[x])
        before, after = np.float32(cost_before[x]), np.float32(cost_after[x])
        slope = max(before, after) - best
        sloped = slope > zero
        offset = half * (before - after) / (slope if sloped else one)
        offset = offset if sloped and rules.fit else zero

        vertex = max(best - half * abs(before - after), zero)
        noise = noise_of_one * vertex / (slope if sloped else one)
        sigma = min(np.sqrt(variance_floor + noise * noise), largest)
        sigma = sigma if sloped else largest

        margin = (second - best) / (pixels + best)
        odds = odds_of_one * np.sqrt(margin / (sigma * sigma * sigma))
        confidence = odds / (odds + one)
        confidence = confidence if second_cost[x] != NO_COST else zero
        if_wrong = max(sigma, np.float32(WRONG_PX))
        variance = confidence * (sigma * sigma) + (one - confidence) * (if_wrong * if_wrong)

        valid = reasons[x] == VALID
        values[x] = minimum + np.float32(winner[x]) + offset if valid else nan
        confidences[x] = confidence if valid else zero
        sigmas[x] = min(np.sqrt(variance), largest) if valid else nan
