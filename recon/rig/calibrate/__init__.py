"""Stereo calibration from images of a board, in the order of `recon calibrate`.

- `board_views.py`: still views of a video, and the board in all images; `detect.py`: the board in
  one image, and whether it has the stated size;
- `stereo.py`: first guesses, and both cameras without the views that do not fit; `bundle.py`: the
  solver;
- `bootstrap.py`: how sure the fit is; `result.py`: its figures and files; `verdict.py`: what it is
  good for.
"""
