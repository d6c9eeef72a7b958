"""What is free and what is occupied: log-odds of voxels, which `recon.map.builders` makes of rays.

- `part.py`: the occupancy of one submap, to be chained with others, and where in its cells the
  surface is;
- `moving.py`: which points moved: candidates by their sums, judged in `bodies.py` by what single
  frames saw of them, unless the error of depths explains it;
- `gone.py`: what left before a plain wall, by its texture that is not seen again.
"""
