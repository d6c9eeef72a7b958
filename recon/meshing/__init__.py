"""From a cloud to a trimmed surface."""
