"""Record what `recon.commands.kernels` compiles ahead: the calls of kernels that commands make.

    python scripts/record_kernels.py

Each command runs once, on small rendered images, in a process of its own. To be run after a change
of what a kernel takes or who calls one; `tests/commands/test_kernels.py` finds a call that lacks.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numba import types
from numba.core.dispatcher import Dispatcher

from recon.commands.config import PAIR_DEFAULTS, ReconConfig, load_config
from recon.commands.demo import demo_source, run_demo
from recon.commands.export import run_occupancy
from recon.commands.kernels import RECORDED
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.commands.pair import run_pair
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.kernels.cache import PACKAGE, with_imports
from recon.core.kernels.voxels import distinct_keys, pack_keys
from recon.core.values import StereoPair
from recon.io.models.octomap import read_octomap
from recon.map.drive.sequence import MappedSequence, map_sequence
from recon.map.occupancy.bodies import dynamic_cells
from recon.map.tiles import Tiles
from recon.run.finished import OCTOMAP
from recon.sources.one_pair import PairInput
from recon.stereo.frame import FrameReconstructor
from recon.stereo.match.registry import MATCHERS

SMALL = (
    "street.frames=6", "street.width_px=192", "street.height_px=96", "street.focal_px=120",
    "submaps.length_m=2",
)  # fmt: skip
MATCHED_BY = tuple(name for name in MATCHERS if name != "onnx")  # it needs a network


def rendered(*, grey: bool = False) -> PairInput:
    source = demo_source(load_config(None, SMALL))
    pair = next(source.frames())
    if grey:
        pair = StereoPair(*(image[:, :, 1].copy() for image in (pair.left, pair.right)))
    return PairInput(pair, source.calibration)


def of_matcher(name: str) -> ReconConfig:
    return load_config(None, [f"matching.matcher={name}"], PAIR_DEFAULTS)


def match(name: str, folder: Path, *, grey: bool = False) -> None:
    given = rendered(grey=grey)
    Calls.seen.clear()  # those of rendering
    run_pair(given, of_matcher(name), out=folder / "pair")


def map_drive(folder: Path) -> None:
    config = load_config(None, SMALL)
    frames = demo_source(config)
    list(frames.frames())
    Calls.seen.clear()
    run_map(frames, config, MapOptions("map", folder / "map", audit=False))
    look_for_what_moved(map_sequence(frames, config))


def look_for_what_moved(mapped: MappedSequence) -> None:
    """Ask what frames saw of the points of a drive, as if they had moved: here nothing does."""
    observations = mapped.tiles.observations
    xyz = np.concatenate([tile.cloud.xyz for tile in mapped.tiles])
    keys = distinct_keys(
        pack_keys(np.floor(xyz / observations.settings.resolution_m).astype(np.int64))
    )
    dynamic_cells(keys, np.ones(len(keys), np.bool_), observations.at(keys))


def others(folder: Path) -> None:
    """Occupancy maps, grey images, and submaps that closed loops have moved."""
    config = load_config(None, SMALL)
    run_demo(config, out=folder / "drive")
    run_occupancy(folder / "drive", out=folder / "occupancy")
    read_octomap(folder / "drive" / OCTOMAP)  # as an evaluation does
    mapped = map_sequence(demo_source(config), config)
    turn = make_transform(exp_so3(np.array([0.0, 0.01, 0.0])), np.zeros(3))
    submaps = mapped.session.submaps
    turns = np.stack([turn] * len(submaps))
    len(Tiles.of_submaps(submaps, mapped.config, mapped.T_map_world, turns))
    for kind in (False, True):
        given = rendered(grey=kind)
        for name in MATCHED_BY:
            run_pair(given, of_matcher(name), out=folder / f"{name}_{kind}")
            FrameReconstructor(given.calibration, of_matcher(name)).reconstruct(given.pair)


COMMANDS: Mapping[str, Callable[[Path], object]] = {
    **{name: lambda folder, name=name: match(name, folder) for name in MATCHED_BY},
    "map": map_drive,
    "demo": lambda folder: run_demo(load_config(None, SMALL), out=folder / "demo"),
    "others": others,
}


class Calls:
    """The calls that this process has made from Python, each once."""

    seen: ClassVar[dict[tuple[str, str, str], None]] = {}

    @classmethod
    def note(cls) -> None:
        """Note calls from now on: numba asks for the types of those that it does not know."""
        original = Dispatcher._compile_for_args

        def noted(kernel: Dispatcher, *arguments: Any, **named: Any) -> Any:
            module = kernel.py_func.__module__.removeprefix("recon.")
            if ".kernels" in module:
                text = json.dumps([written(kernel.typeof_pyval(one)) for one in arguments])
                cls.seen[module, kernel.py_func.__name__, text] = None
            return original(kernel, *arguments, **named)

        Dispatcher._compile_for_args = noted


def written(kind: types.Type) -> str | list[Any]:
    """Write a type as `recon.commands.kernels` reads it."""
    if isinstance(kind, types.Array):
        return f"{kind.dtype} {kind.ndim} {kind.layout}" + " readonly" * (not kind.mutable)
    if not isinstance(kind, types.BaseTuple):
        return str(kind)
    named = getattr(kind, "instance_class", None)
    name = f"{named.__module__.removeprefix('recon.')}.{named.__qualname__}" if named else ""
    return [name, *map(written, kind)]


def recorded(command: str) -> list[tuple[str, str, str]]:
    with tempfile.TemporaryDirectory() as folder:
        Calls.note()
        COMMANDS[command](Path(folder))
    return list(Calls.seen)


def effort(call: tuple[tuple[str, str, str], list[str]]) -> tuple[int, tuple[str, str, str]]:
    """The more source the file of a call has, with what it imports, the longer it takes."""
    source = PACKAGE.joinpath(*call[0][0].split(".")).with_suffix(".py")
    return -sum(path.stat().st_size for path in with_imports(source, PACKAGE)), call[0]


def main() -> None:
    needed_by: dict[tuple[str, str, str], list[str]] = {}
    for command in COMMANDS:
        print(f"record {command}", file=sys.stderr)
        program = [sys.executable, __file__, command]
        done = subprocess.run(program, stdout=subprocess.PIPE, text=True, check=True)
        for call in json.loads(done.stdout.splitlines()[-1]):
            needed_by.setdefault(tuple(call), []).append(command)
    lines = [
        json.dumps([module, name, json.loads(kinds), commands])
        for (module, name, kinds), commands in sorted(needed_by.items(), key=effort)
    ]
    RECORDED.write_text("[\n" + ",\n".join(lines) + "\n]\n")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(recorded(sys.argv[1])))
    else:
        main()
