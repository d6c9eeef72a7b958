"""What is free and what is occupied: log-odds of voxels, from rays."""
