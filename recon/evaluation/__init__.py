"""Evaluation of disparity maps, trajectories, clouds and occupancy against ground truth."""

from recon.evaluation.association import associate
from recon.evaluation.confidence import (
    Reliability,
    Sparsification,
    measure_reliability,
    measure_sparsification,
    share_within_sigma,
)
from recon.evaluation.disparity import evaluate_depth, evaluate_disparity
from recon.evaluation.map import evaluate_map, nearest_distances, register_cloud, within_reach
from recon.evaluation.middlebury.rules import MiddleburyRules, evaluate_middlebury
from recon.evaluation.occupancy import evaluate_occupancy, grid_on_truth
from recon.evaluation.trajectory import (
    TrajectoryComparison,
    TrajectoryRules,
    compare_paths,
    evaluate_trajectory,
)

__all__ = [
    "MiddleburyRules",
    "Reliability",
    "Sparsification",
    "TrajectoryComparison",
    "TrajectoryRules",
    "associate",
    "compare_paths",
    "evaluate_depth",
    "evaluate_disparity",
    "evaluate_map",
    "evaluate_middlebury",
    "evaluate_occupancy",
    "evaluate_trajectory",
    "grid_on_truth",
    "measure_reliability",
    "measure_sparsification",
    "nearest_distances",
    "register_cloud",
    "share_within_sigma",
    "within_reach",
]
