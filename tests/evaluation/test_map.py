"""Map metrics on clouds with known distances."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import EvaluationError
from recon.core.values import PointCloud
from recon.evaluation.map import evaluate_map, nearest_distances
from recon.io.models.ply import read_ply


def grid(offset_m: float = 0.0, step_m: float = 0.5, n: int = 20) -> np.ndarray:
    x, y = np.meshgrid(np.arange(n) * step_m, np.arange(n) * step_m)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, offset_m)], axis=1).astype(np.float32)


def cloud(xyz: np.ndarray) -> PointCloud:
    return PointCloud(xyz.astype(np.float32))


def test_an_offset_is_the_median_and_decides_at_the_threshold() -> None:
    same = evaluate_map(cloud(grid()), cloud(grid()), 0.2)
    assert (same.precision, same.recall, same.f_score) == (1, 1, 1)
    # The distance of a point to itself, squared and rooted in single precision.
    assert 0 <= same.median_m <= same.p95_m < 1e-3
    assert (same.points, same.reference_points) == (400, 400)
    near = evaluate_map(cloud(grid(0.15)), cloud(grid()), 0.2)
    assert near.median_m == pytest.approx(0.15, abs=1e-4)
    assert near.p95_m == pytest.approx(0.15, abs=1e-4)
    assert near.f_score == 1
    far = evaluate_map(cloud(grid(0.25)), cloud(grid()), 0.2)
    assert (far.precision, far.recall, far.f_score) == (0, 0, 0)


def test_precision_counts_wrong_points_and_recall_missing_ones() -> None:
    right, wrong = grid()[:320], grid(5.0)[:80]
    clouds = cloud(np.concatenate([right[:240], wrong])), cloud(grid())
    there, back = evaluate_map(*clouds, 0.2), evaluate_map(*clouds[::-1], 0.2)
    assert (there.precision, there.recall) == pytest.approx((0.75, 0.6))
    assert (back.precision, back.recall) == pytest.approx((0.6, 0.75))
    assert there.f_score == back.f_score == pytest.approx(2 * 0.75 * 0.6 / 1.35)


def test_density_does_not_weigh() -> None:
    rng = np.random.default_rng(0)
    dense_wrong = rng.uniform([0, 0, 4], [0.05, 0.05, 4.05], (5000, 3))
    result = evaluate_map(cloud(np.concatenate([grid(), dense_wrong])), cloud(grid()), 0.2)
    assert result.precision >= 400 / 408  # the heap fills at most eight voxels


def test_distances_hold_far_from_the_origin() -> None:
    far = np.array([4000.0, 0, 9000.0])
    distances = nearest_distances(
        (grid(0.125) + far).astype(np.float32), (grid() + far).astype(np.float32)
    )
    # float32 places points at 9 km to half a millimetre.
    np.testing.assert_allclose(distances, 0.125, atol=2e-3)


@pytest.mark.parametrize(
    ("estimate", "reference", "threshold_m", "complaint"),
    [
        (cloud(np.zeros((0, 3))), cloud(grid()), 0.2, "estimated cloud is empty"),
        (cloud(grid()), cloud(np.zeros((0, 3))), 0.2, "reference cloud is empty"),
        (cloud(grid()), PointCloud(grid(), frame="map"), 0.2, "different frames"),
        (cloud(grid()), cloud(grid()), 0.0, "threshold is not positive"),
        (cloud(grid()), cloud(grid()), float("nan"), "threshold is not positive"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    estimate: PointCloud, reference: PointCloud, threshold_m: float, complaint: str
) -> None:
    with pytest.raises(EvaluationError, match=complaint):
        evaluate_map(estimate, reference, threshold_m)


@pytest.mark.real
def test_the_lidar_map_agrees_with_half_of_itself(recon_data: Path) -> None:
    reference = read_ply(recon_data / "driven" / "kitti_raw_0013" / "lidar_map.ply")
    half = reference.select(np.arange(0, len(reference), 2))
    result = evaluate_map(half, reference, 0.2)
    assert result.precision == 1
    assert 0.9 < result.recall <= 1
