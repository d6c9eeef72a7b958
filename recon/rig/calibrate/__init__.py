"""Stereo calibration from images of a board, in the order of `recon calibrate`.

- `board_views.py`: still views of a video, and the board in all images; `detect.py`: the board in
  one image, and whether it has the stated size;
- `stereo.py`: first guesses, and both cameras without the views that do not fit; `bundle.py`: the
  solver;
- `bootstrap.py`: how sure the fit is; `figures.py`: how well it describes the views; `verdict.py`:
  what it is good for; `result.py`: all of it, and its files.
"""
