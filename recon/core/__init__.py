"""What every layer stands on: values, geometry, errors, settings, compiled loops.

- `values/`: the data types, checked when they are made; `geometry/se3.py`: poses;
- `errors.py`: one tree, one line each; `settings.py`: the base of all settings;
- `kernels/compiled.py`: how loops are compiled; `kernels/cache.py`: where machine code is kept;
- `kernels/voxels.py`: hashes and sets of packed cells;
- `lazy.py`: libraries, and what draws values, loaded when they are used;
- `deprecated.py`: names that are replaced;
- `plugins.py`: parts that others write, registered by packages or given as objects;
- `text.py`: numbers read from text and written with words and units;
- `dates.py`: when a drive began, and by what that is known;
- `summary.py`: what a command found, as a value, and how it becomes JSON;
- `progress.py`: who is told how far work is; `work.py`: threads, and seconds per stage;
  `machine.py`: cores, memory and its limit, versions;
- `geometry/alignment.py`: least squares.
"""
