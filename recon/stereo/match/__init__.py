"""From a rectified pair to a disparity for each pixel."""
