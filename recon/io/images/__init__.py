"""Images, frames of videos in messages (`packets.py`), and disparity maps."""
