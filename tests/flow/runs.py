"""Runs that are broken off, and what they leave."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from recon.core.errors import FormatError
from recon.core.progress import Silent
from recon.core.values import StereoCalibration
from recon.look.fault import NAMES
from recon.look.fit import FittedFault
from recon.look.rig import RefinedRig
from recon.map.drive.mapper import FrameResult
from recon.map.map import Map
from recon.stereo.rectify.epipolar import correct_rig

ROOT = Path(__file__).parents[2]
RECON = [sys.executable, "-m", "recon"]
STATE = Path(".partial", ".state", "map.recon")


class Breaks(Silent):
    """A progress that ends a run before a frame is reported."""

    def __init__(self, frame: int = -1, error: BaseException | None = None) -> None:
        self.frame, self.error = frame, error or KeyboardInterrupt()

    def on_step(self, result: FrameResult) -> None:
        if getattr(result, "index", None) == self.frame:
            raise self.error


def broken(mode: str, at: int, out: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run a command that ends at its n-th write, as `break_at_write.py` says."""
    breaker = Path(__file__).with_name("break_at_write.py")
    command = map(str, (sys.executable, breaker, mode, at, *words, "--quiet"))
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COUNT": f"{out}.count"}
    return subprocess.run([*command], env=environment, capture_output=True, text=True, check=False)


def count_writes(out: Path, *words: object) -> int:
    done = broken("count", 0, out, *words)
    assert done.returncode == 0, done.stderr
    return int(Path(f"{out}.count").read_text())


def begun(out: Path) -> bool:
    try:
        with Map.open(out / STATE) as unfinished:
            return len(unfinished.sessions) > 0
    except FormatError:
        return False


def content(folder: Path) -> dict[str, bytes]:
    """All files of a run except those with timings."""
    timed = {"summary.json", "run.json", "report.html"}
    files = [path for path in folder.rglob("*") if path.is_file() and ".partial" not in path.parts]
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in files
        if path.name not in timed
    }


def summary_of(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "summary.json").read_text()))


def all_files(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def keep_turned_rig(path: Path) -> StereoCalibration:
    """Give the first drive of a map a rig whose right camera is turned; it is returned."""
    with Map.open(path, read_only=False) as map_:
        camera, size = map_.session().camera, len(NAMES)
        turned = correct_rig(camera, np.array([0.0, 1e-3, 0.0, 0.0]), np.eye(3))
        fitted = FittedFault(np.zeros(size), np.eye(size), np.zeros(size), 1.0, 12)
        map_.session().set_rig(RefinedRig(camera, turned, camera, fitted))
        map_.commit()
    return turned
