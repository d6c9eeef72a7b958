"""What is free and what is occupied: log-odds of voxels, from rays.

- `builder.py`: rays become log-odds, and which rays of a frame are kept;
- `part.py`: the occupancy of one submap, to be chained with others, and where in its cells the
  surface is;
- `moving.py`: which points moved: candidates by their sums, judged in `bodies.py` by what single
  frames saw of them.
"""
