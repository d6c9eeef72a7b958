"""Runs `recon` and ends with the process that started it, however that one ends.

Standard input is a pipe from there: when it closes, the whole group of processes is killed.

    python -m recon.run.batch.guard map drive --out folder
"""

from __future__ import annotations

import os
import runpy
import signal
import threading


def _end_with_the_pipe() -> None:
    while os.read(0, 1024):
        pass
    os.killpg(os.getpgid(0), signal.SIGKILL)


if __name__ == "__main__":
    threading.Thread(target=_end_with_the_pipe, daemon=True).start()
    runpy.run_module("recon", run_name="__main__", alter_sys=True)
