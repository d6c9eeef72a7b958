"""Where stereo pairs come from: one class per kind of input."""
