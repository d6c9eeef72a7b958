"""Run folders from elsewhere, altered on the way: finished runs and interrupted ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from recon.io.tree_file import read_tree, write_tree
from recon.run.directory import STARTED
from tests.hostile.calibrations import deep
from tests.hostile.refusals import assert_refused, run
from tests.hostile.runs import STATE

pytestmark = pytest.mark.timeout(120)
Alter = Callable[[Path], None]


def replaced(content: bytes) -> Alter:
    """Replace the content of a file."""
    return lambda path: (path.unlink(), path.write_bytes(content))[0]


def cut(share: float) -> Alter:
    """Keep the beginning of a file."""
    return lambda path: replaced(path.read_bytes()[: int(share * path.stat().st_size)])(path)


def pose(T: Any) -> Alter:
    """Replace T_map_world in a record."""

    def alter(path: Path) -> None:
        record = json.loads(path.read_text())
        path.write_text(json.dumps({**record, "T_map_world": T}))

    return alter


def moved(metres: float) -> list[list[float]]:
    """A pose far away."""
    T = np.eye(4)
    T[:3, 3] = metres
    return T.tolist()


RECORDS: Final[dict[str, Alter]] = {
    "empty": replaced(b""),
    "cut": cut(0.5),
    "no JSON": replaced(b"run"),
    "a list": replaced(b"[]"),
    "a number": replaced(b"1"),
    "a string": replaced(b'"run"'),
    "5000 digits": replaced(b"9" * 5000),
    "not UTF-8": replaced(b"\xff\xfe{}"),
    "nested": replaced(b"[" * 100_000),
    "no pose": replaced(b"{}"),
    "pose is null": pose(None),
    "pose is a word": pose("eye"),
    "pose is ragged": pose([[1, 0], [0]]),
    "pose is 3x3": pose(np.eye(3).tolist()),
    "pose of words": pose([["a"] * 4] * 4),
    "pose of NaN": pose([[float("nan")] * 4] * 4),
    "pose with infinity": pose(moved(float("inf"))),
    "pose of zeros": pose(np.zeros((4, 4)).tolist()),
    "pose mirrored": pose(np.diag([1.0, 1.0, -1.0, 1.0]).tolist()),
    "pose scaled": pose(np.diag([2.0, 2.0, 2.0, 1.0]).tolist()),
    "pose projective": pose((np.eye(4) + np.eye(4)[[3, 2, 1, 0]]).tolist()),
    "pose 1e7 m off": pose(moved(1e7)),
    "pose 1e30 m off": pose(moved(1e30)),
    "pose 1e308 m off": pose(moved(1e308)),
    "pose of huge integers": pose([[10**400] * 4] * 4),
}
COMMANDS: Final = {
    "occupancy": ("occupancy", "run", "--out", "out"),
    "mesh": ("mesh", "run", "--out", "out"),
    "evaluate occupancy": ("evaluate", "occupancy", "run"),
}


@pytest.mark.parametrize("change", RECORDS)
@pytest.mark.parametrize("command", COMMANDS)
def test_an_altered_record_is_refused(command: str, change: str, finished: Path) -> None:
    RECORDS[change](finished / "run.json")
    assert_refused(run(*COMMANDS[command]), "run")
    assert not Path("out").exists()


CONFIGS: Final[dict[str, Alter]] = {
    "cut": cut(0.31),
    "a list": replaced(b"[]"),
    "not UTF-8": replaced(b"\xff\xfe"),
    "tagged": replaced(b"fusion: {voxel_m: !!int abc}"),
    "a date": replaced(b"fusion: {voxel_m: 2020-13-45}"),
    "a class": replaced(b"fusion: !!python/object/apply:os.system [ls]"),
    "an alias": replaced(b"fusion: &a {voxel_m: *a}"),
    "NaN": replaced(b"occupancy: {resolution_m: .nan}"),
    "5000 digits": replaced(b"occupancy: {resolution_m: " + b"9" * 5000 + b"}"),
    "an unknown setting": replaced(b"occupancy: {nothing: 1}"),
    "a list for a group": replaced(b"occupancy: [1]"),
    "nested": replaced(deep(20_000)["yaml maps"].encode()),
}


@pytest.mark.parametrize("change", CONFIGS)
def test_an_altered_configuration_is_refused(change: str, finished: Path) -> None:
    CONFIGS[change](finished / "config.yaml")
    assert_refused(run(*COMMANDS["occupancy"]), "config.yaml")
    assert not Path("out").exists()


@pytest.mark.parametrize("command", ["occupancy", "mesh"])
def test_a_run_with_settings_of_another_version_is_to_be_mapped_again(
    command: str, finished: Path
) -> None:
    replaced(b"inspection: {every: 50}\n")(finished / "config.yaml")
    assert_refused(run(*COMMANDS[command]), "map the drive again")
    assert not Path("out").exists()


def flipped(at: float) -> Alter:
    """Flip all bits of one byte."""

    def alter(path: Path) -> None:
        content = bytearray(path.read_bytes())
        content[int(at * (len(content) - 1))] ^= 0xFF
        replaced(bytes(content))(path)

    return alter


def frame_of(count: int) -> Alter:
    """Let the first frame of a ray file claim a number of rays."""

    def alter(path: Path) -> None:
        content = path.read_bytes()
        replaced(content[:40] + count.to_bytes(4, "little") + content[44:])(path)

    return alter


def grain_of(*numbers: float) -> Alter:
    """Replace cell, unit and range in the header of a ray file."""
    packed = np.array(numbers, "<f8").tobytes()
    return lambda path: replaced(path.read_bytes()[:16] + packed + path.read_bytes()[40:])(path)


RAYS: Final[dict[str, Alter]] = {
    "empty": replaced(b""),
    "cut in the header": cut(0.00001),
    "cut": cut(0.6),
    "another kind": replaced(b"ply\n"),
    "flipped": flipped(0.5),
    "no ray counted": frame_of(0),
    "too many rays counted": frame_of(2**32 - 1),
    "NaN as grain": grain_of(float("nan"), float("nan"), float("nan")),
    "infinite grain": grain_of(0.05, float("inf"), 30.0),
    "unit of 1e30 m": grain_of(0.05, 1e30, 30.0),
    "unit of 1e300 m": grain_of(0.05, 1e300, 30.0),
    "negative unit": grain_of(0.05, -1.0, 30.0),
    "unit of 0": grain_of(0.05, 0.0, 30.0),
    "missing": Path.unlink,
}


@pytest.mark.parametrize("change", RAYS)
def test_altered_rays_are_refused(change: str, finished: Path) -> None:
    RAYS[change](finished / "map" / "rays.bin")
    assert_refused(run(*COMMANDS["occupancy"]), "rays.bin")
    assert not Path("out").exists()


PATHS: Final[dict[str, Alter]] = {
    "empty": replaced(b""),
    "cut": cut(0.5),
    "words": replaced(b"one two\n"),
    "NaN": replaced(b"nan 0 0 0 0 1 0 0 0 0 1 0\n" * 5),
    "far": replaced(b"1 0 0 1e30 0 1 0 0 0 0 1 0\n" * 5),
    "no rotation": replaced(b"1 1 1 0 1 1 1 0 1 1 1 0\n" * 5),
    "5000 digits": replaced(b"9" * 5000 + b" 0 0 0 0 1 0 0 0 0 1 0\n"),
    "a pose too many": replaced(b"1 0 0 0 0 1 0 0 0 0 1 0\n" * 7),
    "missing": Path.unlink,
}


@pytest.mark.parametrize("change", PATHS)
def test_an_altered_path_is_refused(change: str, finished: Path) -> None:
    PATHS[change](finished / "trajectory_kitti.txt")
    assert_refused(run(*COMMANDS["occupancy"]))
    assert not Path("out").exists()


def identity(part: str, value: Any) -> Alter:
    """Replace a part of what a run was started with."""

    def alter(path: Path) -> None:
        started = json.loads(path.read_text())
        path.write_text(json.dumps({**started, part: value}))

    return alter


STARTS: Final[dict[str, Alter]] = {
    "empty": replaced(b""),
    "cut": cut(0.5),
    "a list": replaced(b"[]"),
    "a number": replaced(b"7"),
    "nothing": replaced(b"{}"),
    "5000 digits": replaced(b"9" * 5000),
    "nested": replaced(b"[" * 100_000),
    "not UTF-8": replaced(b"\xff"),
    "identity is a list": identity("identity", []),
    "identity is empty": identity("identity", {}),
    "configuration is a list": identity("identity", {"config": []}),
    "configuration is of another program": identity("identity", {"config": {"a": 1}}),
    "arguments are a list": identity("arguments", []),
    "arguments are null": identity("arguments", None),
    "source is a number": identity("arguments", {"source": 7}),
    "source is a list": identity("arguments", {"source": ["a"]}),
    "source is missing": identity("arguments", {}),
    "source does not exist": identity("arguments", {"source": "/nonexistent"}),
    "kind is a number": identity("arguments", {"source": "/", "kind": 7}),
    "prior is a list": identity("arguments", {"source": "/", "prior": []}),
}


@pytest.mark.parametrize("change", STARTS)
def test_an_altered_start_is_refused(change: str, interrupted: Path) -> None:
    STARTS[change](interrupted / STATE / STARTED)
    assert_refused(run("map", "--resume", interrupted, "--quiet"))
    assert not (interrupted / "run.json").exists()


def tree(change: Callable[[dict[str, Any]], None]) -> Alter:
    """Change the state in a checkpoint, which stays a valid file."""

    def alter(path: Path) -> None:
        state = read_tree(path)
        change(state)
        write_tree(path, state)

    return alter


def every_array(function: Callable[[np.ndarray[Any, Any]], Any]) -> Callable[[Any], None]:
    """Apply a function to every array of a tree, in place."""

    def walk(node: Any) -> None:
        items = node.items() if isinstance(node, dict) else enumerate(node)
        for key, value in list(items):
            if isinstance(value, np.ndarray):
                node[key] = function(value)
            elif isinstance(value, dict | list):
                walk(value)

    return walk


def spoil(*names: str, value: Any) -> Callable[[dict[str, Any]], None]:
    """Set an entry of a tree, given by its names."""

    def change(state: dict[str, Any]) -> None:
        for name in names[:-1]:
            state = state[name]
        assert names[-1] in state
        state[names[-1]] = value

    return change


NAN_POSE: Final = np.full((4, 4), np.nan)
MAPPER: Final = ("mapper",)
FUSED: Final = ("mapper", "odometry", "odometry")
CHECKPOINTS: Final[dict[str, Alter]] = {
    "empty": replaced(b""),
    "cut": cut(0.5),
    "flipped": flipped(0.5),
    "another kind": replaced(b"PK\x03\x04" + bytes(40)),
    "an empty tree": tree(dict.clear),
    "no mapper": tree(spoil("mapper", value=None)),
    "mapper is a list": tree(spoil("mapper", value=[1, 2])),
    "seconds are a word": tree(spoil("seconds", value="many")),
    "all arrays NaN": tree(every_array(lambda a: a * np.nan if a.dtype.kind == "f" else a)),
    "all arrays infinite": tree(every_array(lambda a: a + np.inf if a.dtype.kind == "f" else a)),
    "all arrays empty": tree(every_array(lambda a: a.ravel()[:0])),
    "all arrays flat": tree(every_array(np.ravel)),
    "all arrays double": tree(every_array(lambda a: a.astype(np.float64) * 1.0 + 0.5)),
    "all arrays integers": tree(every_array(lambda a: np.zeros(a.shape, np.int64))),
    "all arrays words": tree(every_array(lambda a: np.full(a.shape, "x"))),
    "all arrays lists": tree(every_array(lambda a: [1, 2])),
    "map pose NaN": tree(spoil(*MAPPER, "T_map_world", value=NAN_POSE)),
    "map pose scaled": tree(spoil(*MAPPER, "T_map_world", value=2 * np.eye(4))),
    "map pose far": tree(spoil(*MAPPER, "T_map_world", value=np.array(moved(1e30)))),
    "map pose a word": tree(spoil(*MAPPER, "T_map_world", value="eye")),
    "odometry null": tree(spoil(*MAPPER, "odometry", value=None)),
    "odometry of bytes": tree(spoil(*MAPPER, "odometry", value=np.zeros(9, np.uint8))),
    "odometry pose NaN": tree(spoil(*FUSED, "T_world_camera", value=NAN_POSE)),
    "odometry covariance 3x3": tree(spoil(*FUSED, "icp_covariance", value=np.eye(3))),
    "odometry counts of words": tree(spoil(*FUSED, "counts", value=["a", "b", "c"])),
    "ICP threshold negative": tree(spoil(*FUSED, "icp", "threshold", value=[-1.0, 0])),
    "ICP points NaN": tree(spoil(*FUSED, "icp", "points", value=np.full((5, 3), np.nan))),
    "ICP points flat": tree(spoil(*FUSED, "icp", "points", value=np.zeros(5))),
    "ICP pose NaN": tree(spoil(*FUSED, "icp", "last_pose", value=NAN_POSE)),
    "submaps null": tree(spoil(*MAPPER, "submaps", value=None)),
    "submaps of words": tree(spoil(*MAPPER, "submaps", value=[["a"]])),
    "rays negative": tree(spoil(*MAPPER, "rays", value=-5)),
    "rays a word": tree(spoil(*MAPPER, "rays", value="many")),
    "rays beyond the file": tree(spoil(*MAPPER, "rays", value=2**60)),
    "frames a word": tree(spoil(*MAPPER, "frames", value="many")),
    "frames beyond the file": tree(spoil(*MAPPER, "frames", value=[9, 2**60, 0])),
    "builder a list": tree(spoil(*MAPPER, "builder", value=[])),
    "builder empty": tree(spoil(*MAPPER, "builder", value={})),
}


@pytest.mark.parametrize("change", CHECKPOINTS)
def test_an_altered_checkpoint_is_refused(change: str, interrupted: Path) -> None:
    CHECKPOINTS[change](interrupted / STATE / "checkpoint.zip")
    assert_refused(run("map", "--resume", interrupted, "--quiet"), "--resume")
    assert not (interrupted / "run.json").exists()
    assert (interrupted / STATE / "checkpoint.zip").exists()


def test_the_interrupted_run_can_be_resumed(interrupted: Path) -> None:
    ended = run("map", "--resume", interrupted, "--quiet")
    assert ended.code == 0, ended.err
    assert (interrupted / "run.json").exists()
