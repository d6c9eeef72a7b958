"""Many commands as jobs, on this machine or on a cluster.

- `job_file.py`: what the user asks for; `plan.py`: the jobs that come of it, all checked first;
- `work.py`: jobs go to workers and come back; `cluster.py`: the workers, by Dask;
- `process.py`: one try of a job on its worker, in a process of its own (`guard.py`);
- `job.py`: a job and how it ended; `figures.py`: the figures of all jobs.
"""
