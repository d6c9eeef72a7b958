"""Observers of a run; the pipeline knows none of them."""
