"""Matching pixels brought to the same row, and what is known of lenses, features and rows."""
