"""What every command shares: the run with its folder, threads, times, progress and memory.

- `run.py`: one run of a command, with its configuration, summary and record;
- `directory.py`: its folder, which is complete or not there; `finished.py`: what it has left;
- `work.py`: work that overlaps, how much memory it may take, seconds per stage, and how far it is;
  `machine.py`: what there is;
- `batch/`: many commands as jobs, on this machine or on a cluster.
"""
