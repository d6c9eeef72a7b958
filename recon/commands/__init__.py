"""One story per command of the program, as functions of the library: `map.py` is `recon map`.

What several of them share: `config.py`, the settings of all stages and their list;
`map_options.py`, what a run is asked for, and how one that was interrupted goes on;
`map_pieces.py`, a drive mapped by workers.
"""
