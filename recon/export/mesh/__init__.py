"""Surface meshes from point clouds, whole or in pieces with closed seams.

- `poisson.py`: the surface of a cloud; `view.py`: that of a single pair, as its camera saw it;
- `pieces.py`: that of a map, piece by piece, cut, joined and trimmed (`cut.py`).
"""
