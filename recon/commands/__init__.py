"""One story per command of the program, as functions of the library: `map.py` is `recon map`.

Of one subject stand together: rigs and recordings in `cameras.py`, several drives in `merge.py`,
products in `export.py`. All share `config.py`, the settings, their list and presets, and
`map_options.py`, what a run is asked for and how one goes on; `map_summary.py` has what those found
that make, join or export maps; `map_pieces.py` is a drive mapped by workers, `live_map.py` one of
which a program has the images.
"""
