"""Surface meshes from point clouds, whole or in pieces with closed seams.

- `poisson.py`: the surface of a cloud; `grid.py`: that of a single pair, of its pixels;
- `voxels.py`: that of a map; `pieces.py`: piece by piece, cut, joined and trimmed (`cut.py`);
- `texture.py`: a map's surface with the images of its drives: `views.py` chooses and blends them,
  `charts.py` lays the surface out in a picture.
"""
