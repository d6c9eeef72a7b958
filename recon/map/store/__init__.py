"""The map on disk: one file of records, and what a session keeps in it.

From the map down to the file:

- `map_file.py`: drives in one file, and which of their frames have a place in it;
- `session.py`: what one drive keeps: path, health, axes, submaps, keyframes, rays, loops;
- `trees.py`: values as records of their kind, and records as JSON and bytes;
- `records.py`: trees of arrays under a kind and a key, in an SQLite file: how it is opened and
  recognised, a cache of the last ones read, commits, and what a full disk means.
"""
