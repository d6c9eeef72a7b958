"""Several drives in one map: copied into it, linked, placed, and taken out again.

In the order of `recon merge`:

- `copying.py`: drives go from one map into another;
- `linking.py`: places that two of them saw; `shared_frames.py`: frames that both have;
- `measured.py`: positions that were measured along them, such as by GNSS;
- `lengths.py`: whether two drives measure the same lengths;
- `joining.py`: linked drives are placed beside one another, in one pose graph;
- `placed.py`: the map is cut into tiles; `spread.py`: by several processes.
"""
