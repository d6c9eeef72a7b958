"""The map on disk: one file of records, and what a session keeps in it.

From the map down to the file:

- `map_file.py`: drives in one file; `session.py`: what one drive keeps in it;
- `frames.py`, `rays.py`, `links.py`: values as records of their kind;
- `submaps.py`, `keyframes.py`, `tile_parts.py`: lists of things that are read one at a time;
- `records.py`: trees of arrays under a kind and a key; `arrays.py`: such a tree as bytes;
- `values.py`: a value made of such a tree, its parts checked;
- `database.py`: the SQLite file, its commits, and what a full disk means; `cache.py`: last reads.

What is made of a finished drive: `keep_map.py` (the file that a run keeps), `cast_submaps.py`
(occupancy from its rays again), `map_views.py` (its keyframes, to be recognised).
"""
