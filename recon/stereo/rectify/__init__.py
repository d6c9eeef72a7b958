"""Matching pixels brought to the same row, and what is known of cameras and rows.

- `rectifier.py`: both images are warped; `wide.py`: those of wide-angle lenses; `grey.py`: colours;
- `lens.py`: lens models; `epipolar.py`: epipolar lines;
- `features.py`: features matched between two images; `inspect.py`: are rows aligned, sides swapped?
"""
