"""One file per heavy library: arrays in, arrays out, its exceptions converted to ours."""
