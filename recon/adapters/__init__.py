"""One file per heavy library: arrays in, arrays out, foreign exceptions turned into ours."""
