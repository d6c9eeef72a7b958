"""What leaves a map: one module per product.

- `make.py`: the table of products, and the loop that makes them of a map, for every command;
- `product.py`: what a product gets, and what it gives back;
- `cloud.py`, `occupancy.py`, `costmap.py`, `survey.py`, `rasters.py`, `mesh/pieces.py`: one kind of
  product each, from tiles; `colmap.py`, `nerfstudio.py`, `mcap.py`: for other tools, with the
  images of the drives (`images.py`);
- `trajectories.py`: the paths of drives; `pair.py`: what is made of a single pair, or of a cloud;
- `mesh/`: surfaces, of clouds, pairs and maps, and their textures.
"""
