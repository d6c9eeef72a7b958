"""A rendered street drive with exact truth."""
