"""One drive becoming a map: the loop over frames, its state and its results.

- `sequence.py`: from a source to a mapped drive, or why it is empty;
- `drive.py`: the loop over frames, matched ahead or (while they arrive) behind; commits; the map,
  threads and stopwatch of a drive;
- `mapper.py`: what is done with one frame: its pose, then its part of the submap under
  construction;
- `levelling.py`: the map made level by all frames, when they are in it;
- `scale.py`: how large the scene is, from which lengths follow;
- `drive_odometry.py`: which odometry finds the poses; `drive_loops.py`: loops, in a thread.
"""
