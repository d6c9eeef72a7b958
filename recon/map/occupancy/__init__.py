"""What is free and what is occupied: log-odds of voxels, from rays.

- `rays.py`: what is kept of a frame; `builder.py`: rays become log-odds;
- `part.py`: the occupancy of one submap, to be chained with others; `surface_points.py`: where in a
  cell the surface is;
- `moving.py`: which points moved: candidates by their sums, judged in `bodies.py` by what single
  frames saw of them (`looks.py`); `free_space.py`: which points lie in space seen through.
"""
