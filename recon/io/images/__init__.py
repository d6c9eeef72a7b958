"""Images, videos and disparity maps."""
