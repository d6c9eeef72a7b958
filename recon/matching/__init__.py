"""From a rectified pair to a disparity with confidence and reasons."""
