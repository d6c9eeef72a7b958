"""What leaves a map: one module per product.

- `make.py`: the table of products, and the loop that makes them of a map, for every command;
- `product.py`: what a product gets, the images of the drives too, and what it gives back;
- `cloud.py`, `occupancy.py`, `costmap.py`, `rasters.py`, `web.py`, `mesh/pieces.py`: from tiles;
  `colmap.py`, `nerfstudio.py`, `mcap.py`: for other tools, with images;
- `trajectories.py`: the paths of drives; `pair.py`: what is made of a single pair, or of a cloud;
- `robot.py`: topics of a robot while it drives, with its map as far as it is made, `growing.py`;
- `mesh/`: surfaces, of clouds, pairs and maps, and their textures.
"""
