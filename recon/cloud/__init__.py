"""From a disparity to a clean cloud of points with their errors."""
