"""What leaves a map: one module per product.

- `products.py`: all that `recon map` makes; `remake.py`: what `recon export` makes again;
- `cloud.py`, `grid.py`, `octomap.py`, `mesh/pieces.py`: one product each, from tiles;
- `pair.py`: the files of a single pair; `mesh/poisson.py`: the surface of a cloud.
"""
