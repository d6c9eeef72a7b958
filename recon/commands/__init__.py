"""One story per command of the program, as functions of the library.

`map.py` is `recon map`, and so on; each reads like the paragraph that explains it. What several of
them share:

- `config.py`: settings of all stages; `settings_list.py`: the same, described;
- `map_options.py`: what is mapped with what; `resume.py`, `identity.py`: interrupted runs;
- `map_pieces.py`, `piece.py`: a drive mapped by workers; `joined.py`: several drives in one map.

`api.py` is for Python alone.
"""
