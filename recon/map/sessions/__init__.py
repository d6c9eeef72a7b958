"""Several drives in one map: copied into it, linked, placed, and taken out again.

- `copying.py`: drives go from one map into another, or into the file that is kept;
- `joining.py`: places that two of them saw link them; linked ones are placed in one pose graph;
- `measured.py`: positions that were measured along them, such as by GNSS;
- `tending.py`: what newer drives saw again is forgotten, as far as `keep.py` says;
- `placed.py`: occupancy is made from kept rays again, and the map cut into tiles, by one process or
  several.
"""
