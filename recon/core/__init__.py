"""What every room stands on: values, geometry, errors, settings, compiled loops.

- `values/`: the data types, checked when they are made; `geometry/se3.py`: poses;
- `errors.py`: one tree, one line each; `settings.py`: the base of all settings;
- `kernels/compiled.py`: how loops are compiled; `kernels/cache.py`: where machine code is kept;
- `decimals.py`: numbers in text from outside;
- `words.py`: numbers of things in words; `units.py`: units of figures;
- `keys.py`: sets of packed cells;
- `least_squares.py`: the loop of every non-linear fit.
"""
