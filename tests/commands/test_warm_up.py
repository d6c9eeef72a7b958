"""After `recon doctor --compile` no command of a first run waits for the compiler."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

import recon

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3600),  # two minutes of a core of its own; others may have most of it
    pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="kernels are not compiled"),
]

NOT_IN_CACHE = """
import importlib, pkgutil
from pathlib import Path
from numba.core.dispatcher import Dispatcher
import recon

for module in pkgutil.walk_packages(recon.__path__, "recon."):
    if ".kernels." not in module.name:
        continue
    for name, kernel in vars(importlib.import_module(module.name)).items():
        if isinstance(kernel, Dispatcher) and kernel.targetoptions.get("inline") != "always":
            if not Path(kernel._cache._cache_file._index_path).exists():
                print(f"{module.name}.{name}")
"""

FIRST_RUN = """
import sys
from pathlib import Path
from recon.cli import app
from recon.io.images.image import write_image
from recon.core.kernels.cache import when_compiling
from recon.sources.synthetic import SyntheticSource
from tests.scenery.kitti import write_kitti
from recon.street.settings import StreetSettings

drive, compiled = Path(sys.argv[1]), []
street = SyntheticSource(StreetSettings(frames=4, width_px=256, height_px=96, focal_px=150.0))
write_kitti(street, drive / "drive")
pair = next(iter(street))
for side in ("left", "right"):
    write_image(drive / f"{side}.png", getattr(pair, side))
    write_image(drive / f"{side}_grey.png", getattr(pair, side)[:, :, 1])
calib = ["--calib", str(drive / "drive" / "calib.txt")]
with when_compiling(compiled.append):
    for matcher in ("sad", "sgm"):
        chosen = ["--matcher", matcher, "--quiet", "--out"]
        for kind in ("", "_grey"):
            images = [str(drive / f"{side}{kind}.png") for side in ("left", "right")]
            app(["pair", *images, *calib, *chosen, str(drive / f"pair{kind}_{matcher}")],
                standalone_mode=False)
        out = str(drive / f"map_{matcher}")
        app(["map", str(drive / "drive"), *chosen, out, "--no-mesh"], standalone_mode=False)
print("compiled:", *compiled)
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """With a cache of kernels of its own, filled by the command."""
    folder = tmp_path_factory.mktemp("cache")
    root = str(Path(recon.__file__).parents[1])
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": root}
    command = [sys.executable, "-m", "recon", "doctor", "--compile", "--json"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout)["kernels"] > 0
    return environment


def printed(code: str, environment: dict[str, str], *arguments: str) -> list[str]:
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_every_kernel_is_compiled(environment: dict[str, str]) -> None:
    assert printed(NOT_IN_CACHE, environment) == []


def test_pairs_and_drives_from_files_compile_nothing_more(
    environment: dict[str, str], tmp_path: Path
) -> None:
    assert printed(FIRST_RUN, environment, str(tmp_path))[-1] == "compiled:"
