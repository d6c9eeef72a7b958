"""Observers that show the progress of a run."""

from recon.cli.show.announce import announce, warn
from recon.cli.show.progress import JsonLines, Quiet, RichProgress, choose_viewer

__all__ = ["JsonLines", "Quiet", "RichProgress", "announce", "choose_viewer", "warn"]
