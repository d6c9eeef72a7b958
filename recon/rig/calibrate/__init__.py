"""Stereo calibration from images of a board.

In the order of `recon calibrate`:

- `board_video.py`: still views of a video; `board_views.py`: the board in all images, found by
  `detect.py`; `board_size.py`: does it have the size that was stated?
- `initial.py`: first guesses; `bundle.py`: cameras and boards fitted at once; `stereo.py`: both
  steps, without the views that do not fit;
- `bootstrap.py`: how sure the fit is; `summary.py`: its figures; `verdict.py`: what it is good for;
- `result.py`: all of that, and the files.
"""
