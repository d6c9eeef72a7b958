"""Observers that show the progress of a run."""

from recon.viewers.announce import announce, warn
from recon.viewers.progress import JsonLines, Quiet, RichProgress, choose_viewer

__all__ = ["JsonLines", "Quiet", "RichProgress", "announce", "choose_viewer", "warn"]
