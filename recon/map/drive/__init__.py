"""One drive becoming a map: the loop over frames, its state and its results."""
