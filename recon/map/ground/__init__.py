"""The ground below the path, and the flat grid above it."""
