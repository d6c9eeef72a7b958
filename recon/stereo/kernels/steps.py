"""Steps of depth: where a window that sees both sides gives one the disparity of the other.

Windows are drawn to the side with more texture, which is mostly the nearer one: its disparity
reaches beyond its edge by half a window. What the image looks like says which side a pixel is of.

Ref: K.-J. Yoon, I. S. Kweon, "Adaptive support-weight approach for correspondence search",
PAMI 28, 2006 (pixels of like colour are of one surface); Z. Ma et al., "Constant time weighted
median filtering for stereo matching and beyond", ICCV 2013 (as a vote on a disparity map).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from recon.core.kernels.compiled import Float32, UInt8, kernel


class Vote(NamedTuple):
    """Who votes on the disparity of a pixel beside a step, and for what."""

    radius: int  # half the square of those who vote, pixels
    stride: int  # every so manieth row and column of it
    same_px: float  # a disparity of the same surface differs by less beside the pixel
    slope: float  # and by so much more with each pixel of distance


@kernel
def mark_steps(values: Float32, reach: int, step_px: float, marked: UInt8) -> None:
    """Mark the pixels within ``reach`` of a step between two neighbours in a row.

    Neighbours are known disparities with no more than ``3·reach`` columns between them: beside a
    step, one side is hidden. Other pixels keep their mark.
    """
    height, width = values.shape
    for y in range(height):
        last = -1
        for x in range(width):
            if np.isnan(values[y, x]):
                continue
            near = last >= 0 and x - last <= 3 * reach
            if near and abs(values[y, x] - values[y, last]) > step_px:
                marked[y, max(last - reach + 1, 0) : min(x + reach, width)] = 1
            last = x


@kernel
def take_votes(
    values: Float32,
    grey: UInt8,
    alike: Float32,
    marked: UInt8,
    vote: Vote,
    first: int,
    end: int,
    own: Float32,
) -> None:
    """Write which fraction of the votes is for the disparity of each marked pixel of some rows.

    The pixels around it vote by how alike they are: ``alike``, float32 (256,), is the weight of a
    difference of grey levels. ``own``, float32 (H, W), is negative where a nearer or a farther
    surface has more votes than its own, and 1 where nothing is marked or known.
    """
    (height, width), reach = values.shape, vote.radius // vote.stride * vote.stride
    for y in range(first, end):
        for x in range(width):
            own[y, x] = 1
            if not marked[y, x] or np.isnan(values[y, x]):
                continue
            value, level = values[y, x], np.int64(grey[y, x])
            nearer, same, farther = np.float32(0), np.float32(0), np.float32(0)
            for dy in range(-reach, reach + 1, vote.stride):
                for dx in range(-reach, reach + 1, vote.stride):
                    v, u = y + dy, x + dx
                    if v < 0 or u < 0 or v >= height or u >= width or np.isnan(values[v, u]):
                        continue
                    weight = alike[abs(np.int64(grey[v, u]) - level)]
                    limit = vote.same_px + vote.slope * max(abs(dy), abs(dx))
                    apart = values[v, u] - value
                    if apart > limit:
                        nearer += weight
                    elif apart < -limit:
                        farther += weight
                    else:
                        same += weight
            ratio = same / (nearer + same + farther)
            own[y, x] = ratio if same >= max(nearer, farther) else ratio - np.float32(1)
