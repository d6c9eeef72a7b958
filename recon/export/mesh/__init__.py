"""Surface meshes from point clouds, whole or in pieces with closed seams.

- `poisson.py`: the surface of a cloud; `grid.py`: that of a single pair, of its pixels;
- `pieces.py`: that of a map, piece by piece, cut, joined and trimmed (`cut.py`);
- `texture.py`: a map's surface with the images of its drives; `charts.py` lays it out in a picture.
"""
