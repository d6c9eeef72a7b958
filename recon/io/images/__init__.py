"""Images and disparity maps."""
