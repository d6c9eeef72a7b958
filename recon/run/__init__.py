"""What every command shares: the run with its folder, threads, times, progress and memory.

- `run.py`: one run of a command, with its configuration, summary and record;
- `directory.py`: its folder, which is complete or not there; `finished.py`: what it has left;
- `progress.py`: how far it is, and seconds per stage;
- `threads.py`: work that overlaps, and how much memory it may take; `machine.py`: what there is;
- `batch/`: many commands as jobs, on this machine or on a cluster.
"""
