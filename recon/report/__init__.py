"""Reports of runs: one self-contained HTML file for each, its figures and its tables.

- `page.py` fills the template of a page (`templates/`); `map_page.py` and its like say with what,
  and draw what is only theirs;
- `drive_figures.py`: figures of several pages; `scene.py`: the view in 3-D;
- `style.py`: look and colours of all of them; `table.py`: text tables.
"""
