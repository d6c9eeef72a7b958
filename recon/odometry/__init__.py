"""From frames to poses: visual odometry, or kiss-icp to compare with.

- `protocol.py`: what every odometry takes and gives; `registry.py`: the odometries by name;
- `visual.py`: features (`visual_features.py`) tracked through a short window of frames
  (`window.py`), and how uncertain the pose is (`visual_uncertainty.py`);
- `kiss.py`: clouds registered over time by `kiss_icp.py`, which also registers in a finished map
  (`recon.map.localize`);
- `checked.py`: poses that cannot be trusted are marked, by all patches of the image
  (`agreement.py`); `health.py`: what that says of a drive; `path_drift.py`: how far it may be off;
- `prior.py`: what wheels or an inertial unit say; `prior_axes.py`: in which axes they say it.
"""
