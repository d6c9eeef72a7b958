"""Sources of stereo pairs: one module per kind of input."""
