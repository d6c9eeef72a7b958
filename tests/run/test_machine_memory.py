"""The reported peak memory is that of the process itself."""

from __future__ import annotations

import platform
import subprocess
import sys

import numpy as np
import pytest

from recon.run.machine import peak_memory_mb

TELL_PEAK = "from recon.run.machine import peak_memory_mb; print(peak_memory_mb())"
FREE_AND_RETURN = """
import resource
from pathlib import Path
from recon.run.machine import return_free_memory

def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

blocks = [b"1" * 60_000 for _ in range(2000)]  # smaller than what malloc maps on its own
last = blocks[-1]  # stays behind them, so that they are a gap
blocks.clear()
freed = resident_bytes()
return_free_memory()
print(freed - resident_bytes())
"""


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


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="malloc_trim is glibc's")
def test_what_was_freed_before_something_that_stays_is_returned() -> None:
    done = subprocess.run(
        [sys.executable, "-c", FREE_AND_RETURN], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) > 100_000_000
