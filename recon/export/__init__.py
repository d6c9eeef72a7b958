"""What leaves a map: one module per product.

- `make.py`: the table of products, and the loop that makes them of a map, for every command;
- `product.py`: what a product gets, the images of the drives too, and what it gives back;
- `cloud.py`, `occupancy.py`, `costmap.py`, `rasters.py`, `mesh/pieces.py`: products from tiles;
  `colmap.py`, `nerfstudio.py`, `mcap.py`: for other tools, with images;
- `trajectories.py`: the paths of drives; `pair.py`: what is made of a single pair, or of a cloud;
- `mesh/`: surfaces, of clouds, pairs and maps, and their textures.
"""
