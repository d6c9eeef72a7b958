"""What every command shares: the run, with its result folder and its record.

- `run.py`: one run of a command, with its configuration, summary and record;
- `directory.py`: its folder, which is complete or not there; `finished.py`: what it has left;
- `batch/`: many commands as jobs, on this machine or on a cluster.
"""
