"""Occupancy maps for robots: Nav2 and OctoMap."""
