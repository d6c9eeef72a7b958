"""Structure from motion: poses of pairs in any order, by COLMAP, with the rig known.

- `find.py`: the whole way, and what cannot be done;
- `colmap.py`: the library, with a database of features and matches;
- `found.py`: what was found, as models of pairs, and as an odometry.
"""
