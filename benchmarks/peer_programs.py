"""Other programs on our frames: ORB-SLAM3 and COLMAP, each in an environment of its own.

``ORBSLAM3`` and ``COLMAP`` are the commands that run them (an interpreter and a script, as for
`benchmarks/peers/README.md`). Where they are not set the programs are not run, and tables say so.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
from altered_drives import errors_of

from recon.core.values import Trajectory
from recon.io.trajectory import read_kitti_poses

PACE_S: Final = 0.3
"""Of a frame for ORB-SLAM3, so that its mapping keeps up on two cores."""


def command_of(program: str) -> list[str] | None:
    """The command of a program; None where there is none."""
    words = shlex.split(os.environ.get(program, ""))
    return words or None


def vocabulary(images: list[Path], to: Path) -> Path | None:
    """Make the words that ORB-SLAM3 needs of folders of images; None where it is not there."""
    command = command_of("ORBSLAM3")
    if command is None:
        return None
    line = [*command, "vocabulary", str(to), *map(str, images)]
    subprocess.run(line, check=True, capture_output=True)
    return to


def orbslam3(
    drive: Path, words: Path | None, frames: int, truth: Trajectory | None
) -> dict[str, Any] | None:
    """Frames that ORB-SLAM3 lost on a drive (KITTI), and the errors of its path; None = not run.

    Errors are left out where it has not a pose for each frame: nothing says which are missing.
    """
    command = command_of("ORBSLAM3")
    if command is None or words is None:
        return None
    poses = drive / "orbslam3.txt"
    line = [*command, "run", str(drive), str(words), str(poses), "--pace", str(PACE_S)]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    said = re.search(r"(\d+) lost", done.stdout)
    if done.returncode or said is None or not poses.is_file():
        return {"frames": frames, "lost": frames, "poses": 0}
    given = len(poses.read_text().splitlines())
    found = {"frames": frames, "poses": given, "lost": int(said[1]) + frames - given}
    if given != frames or truth is None:
        return found
    return {**found, **errors_of(read_kitti_poses(poses, truth.timestamps_s), truth)}
