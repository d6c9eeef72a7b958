"""Readers and writers of file formats; foreign conventions are converted here and nowhere else.

- `cameras/calibration.py` recognises any calibration file; beside it is one module per format;
- `images/image.py`: images; `images/pfm.py`, `images/disparity_png.py`: disparity maps;
- `models/ply.py`, `models/mesh.py`: clouds and meshes; `occupancy/`: OctoMap and Nav2;
- `files.py`: what a parser raises becomes one error that names the file; `atomic.py`: files appear
  whole or not at all; `fields.py`: typed fields of a file.
"""
