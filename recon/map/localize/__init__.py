"""Where a drive is in a map that is there already: recognised first, then tracked."""
