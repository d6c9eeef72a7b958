"""The reported peak memory is that of the process itself."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from recon.run.machine import peak_memory_mb

TELL_PEAK = "from recon.run.machine import peak_memory_mb; print(peak_memory_mb())"


def test_peak_is_not_that_of_the_process_that_started_it() -> None:
    ballast = np.ones(100_000_000)  # 800 MB
    done = subprocess.run(
        [sys.executable, "-c", TELL_PEAK], capture_output=True, text=True, check=True
    )
    assert peak_memory_mb() > ballast.nbytes / 1e6
    assert 10 < float(done.stdout) < 700


def test_peak_stays_when_memory_is_given_back() -> None:
    before = peak_memory_mb()
    ballast = np.ones(100_000_000)
    during = peak_memory_mb()
    del ballast
    assert during >= before
    # Linux adds up what each core counted now and then: a few pages more or less.
    assert peak_memory_mb() > 0.99 * during
