"""From posed clouds to a fused cloud, 3-D occupancy and a flat grid."""
