"""From estimates and truth to figures."""

from recon.evaluation.disparity import evaluate_disparity
from recon.evaluation.map import evaluate_map
from recon.evaluation.trajectory import evaluate_trajectory

__all__ = [
    "evaluate_disparity",
    "evaluate_map",
    "evaluate_trajectory",
]
