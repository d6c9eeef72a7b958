"""What every command shares: the run with its folder, threads, times, progress and memory."""

from recon.run.run import Run

__all__ = ["Run"]
