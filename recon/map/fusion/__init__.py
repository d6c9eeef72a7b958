"""One cloud of all that the frames saw: sums per voxel."""
