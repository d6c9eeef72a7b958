"""From posed clouds to the map: fusion, occupancy, ground, and the store that keeps them.

- `drive/sequence.py`: the loop over frames; `drive/mapper.py`: what it does with one;
- `builders.py`: submaps, consecutive frames with their part of the cloud (`fusion.py`) and of the
  occupancy (`occupancy/part.py`), and how frames become those parts;
- `store/map_file.py`: the file that keeps them; `store/session.py`: what one drive puts into it;
- `tiles.py`: the map in squares, from which all products are made; `cut.py`: submaps are cut into
  them; `ground/grid.py`: the flat map; `esdf.py`: how far places are from obstacles;
- `sessions/joining.py`: several drives in one map; `localize/localizer.py`: a drive found in a map;
- `listener.py`: who is told of a drive while it goes on;
- `map.py`: `recon.Map`, the file with all that can be done with it.
"""
