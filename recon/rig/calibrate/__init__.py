"""Stereo calibration from images of a board, in the order of `recon calibrate`.

- `board_views.py`: still views of a video, and the board in all images; `detect.py`: the board in
  one image, and whether it has the stated size;
- `stereo.py`: first guesses, both cameras without the views that do not fit, and how sure the fit
  is; `bundle.py`: the solver;
- `figures.py`: how well it describes the views; `verdict.py`: all of it, its files, and what it is
  good for.
"""
