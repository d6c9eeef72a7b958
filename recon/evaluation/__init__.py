"""Evaluation of disparity maps, trajectories, clouds and occupancy against ground truth."""
