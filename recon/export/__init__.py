"""What leaves a map: one module per product.

- `make.py`: the table of products, and the loop that makes them of a map, for every command;
- `product.py`: what a product gets, and what it gives back;
- `cloud.py`, `grid.py`, `octomap.py`, `mesh/pieces.py`: one product each, from tiles;
- `map_run.py`, `joined.py`: the results of `recon map`, and of a map of several drives;
- `cloud_file.py`: a cloud in a file, meshed; `pair.py`: the files of a single pair;
- `mesh/poisson.py`: the surface of a cloud.
"""
