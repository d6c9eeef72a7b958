"""Matching pixels brought to the same row, and what is known of cameras and rows.

- `rectifier.py`: both images are warped, and made grey;
- `lens.py`: lens models and epipolar lines;
- `features.py`: features matched between two images: are rows aligned, sides swapped?
"""
