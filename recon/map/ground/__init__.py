"""The ground below the path, and the flat grid above it.

- `axes.py`: map axes, from the ground plane in the first frame;
- `level.py`: what is up, by the surfaces of a whole drive;
- `surface.py`: the ground along the drive, and farther away;
- `grid.py`: voxels flattened to the grid that robots plan on, free where the vehicle drove;
- `traverse.py`: what a robot can drive over.
"""
