"""From frames to poses: visual odometry, structure from motion, or kiss-icp to compare with.

- `protocol.py`: what every odometry takes and gives; `registry.py`: the odometries by name, those
  that are not ours, and known poses as one of them;
- `visual.py`: features, found again from other positions (`features.py`), give a pose, adjusted in
  a short window of frames (`pose.py`);
- `sfm.py`: structure from motion, for pairs in any order, by COLMAP;
- `checked.py`: poses that cannot be trusted are marked, by all patches of the image;
- `health.py`: what that says of a drive, and how far its path may be off;
- `kiss.py`: clouds registered over time, from where the features put the camera, also in a finished
  map (`recon.map.localize`);
- `guide.py`: what other sensors say of the motion: a path (`prior.py`), or an inertial unit
  (`imu.py`), known by what cameras see (`imu_fit.py`).
"""
