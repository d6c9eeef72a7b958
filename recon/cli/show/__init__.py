"""What a command shows beside its results: its source, warnings, progress."""

from recon.cli.show.announce import announce, warn
from recon.cli.show.progress import JsonLines, ProgressBar, choose_viewer

__all__ = ["JsonLines", "ProgressBar", "announce", "choose_viewer", "warn"]
