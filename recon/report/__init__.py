"""Reports of runs: one self-contained HTML file for each, its figures and its tables.

- `page.py` fills the template of a page (`templates/`); `map_page.py` and its like say with what;
- `pair_figures.py`, `drive_figures.py`: the figures; `scene.py`: the view in 3-D;
- `colour.py`, `style.py`: how all of them look; `table.py`: text tables.
"""
