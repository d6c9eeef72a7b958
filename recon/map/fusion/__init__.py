"""One cloud of all that the frames saw: sums per voxel.

- `builder.py`: points of a frame are added with the weight `confidence / sigma_m²`;
- `part.py`: the sums of one submap, which can be moved, joined, and made into points.
"""
