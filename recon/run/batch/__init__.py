"""Many commands as jobs, on this machine or on a cluster.

- `job_file.py`: what the user asks for; `recon.cli.program` makes checked jobs of it;
- `job.py`: a job, how it ended, its log, and one try of it in a process of its own (`guard.py`);
- `cluster.py`: the workers, by Dask; `results.py`: what comes back, what is unusual in it, and how
  a batch stands that somebody else runs.
"""
