"""One look at a drive before anything is made of it; audit, map and localization act on it.

- `look.py`: the look: windows of frames, read, rectified and matched once;
- `sample.py`: which frames, and what is measured in single pairs, and how;
- `tracks.py`: features that are followed through the windows;
- `geometry.py`: rows, swapped or delayed cameras, whether they are rigid to each other;
- `rig.py`: the rig as the motion shows it: `fit.py` fits what `fault.py` describes; `length.py`:
  its baseline, by lengths that were measured;
- `findings.py`: what is wrong with the recording, with advice, and the verdict;
- `settings.py`: what a look can be set to.
"""
