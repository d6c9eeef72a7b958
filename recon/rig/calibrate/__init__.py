"""Stereo calibration from images of a board, in the order of `recon calibrate`.

- `patterns.py`: the kinds of boards, each found in an image, and drawn; `detect.py`: whether one
  has the stated size; `board_views.py`: still views of a video, and the board in all images;
- `guide.py`: what views lack while they are recorded;
- `stereo.py`: first guesses, both cameras without the views that do not fit, and how sure the fit
  is; `bundle.py`: the solver;
- `lenses.py`: which lens model suits; `figures.py`: how well it describes the views; `verdict.py`:
  all of it, its files, and what it is good for.
"""
