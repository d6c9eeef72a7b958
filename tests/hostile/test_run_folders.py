"""Run folders from elsewhere, altered on the way: finished runs and interrupted ones."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from recon.map.store.records import Store
from recon.run.directory import STARTED
from tests.hostile.calibrations import deep
from tests.hostile.conftest import STATE
from tests.hostile.refusals import assert_refused, run

pytestmark = pytest.mark.usefixtures("blank_figures")
Alter = Callable[[Path], None]


def replaced(content: bytes) -> Alter:
    return lambda path: (path.unlink(), path.write_bytes(content))[0]


def cut(ratio: float) -> Alter:
    return lambda path: replaced(path.read_bytes()[: int(ratio * path.stat().st_size)])(path)


def moved(metres: float) -> list[list[float]]:
    T = np.eye(4)
    T[:3, 3] = metres
    return T.tolist()


RECORDS: Final[dict[str, Alter]] = {
    "cut": cut(0.5),
    "nested": replaced(b"[" * 100_000),
    "5000 digits": replaced(b"9" * 5000),
    **{
        text.decode("latin-1") or "empty": replaced(text)
        for text in (b"", b"run", b"[]", b"1", b'"run"', b"\xff\xfe{}", b"{}")
    },
}
POSES: Final[dict[str, Any]] = {
    "null": None,
    "ragged": [[1, 0], [0]],
    "of words": [["a"] * 4] * 4,
    "with infinity": moved(float("inf")),
    "mirrored": np.diag([1.0, 1.0, -1.0, 1.0]).tolist(),
    "projective": (np.eye(4) + np.eye(4)[[3, 2, 1, 0]]).tolist(),
    "1e7 m off": moved(1e7),
    "of huge integers": [[10**400] * 4] * 4,
}
COMMANDS: Final = {
    "occupancy": ("occupancy", "run", "--out", "out"),
    "mesh": ("mesh", "run", "--out", "out"),
    "evaluate occupancy": ("evaluate", "occupancy", "run"),
}


@pytest.mark.parametrize("change", RECORDS)
@pytest.mark.parametrize("command", COMMANDS)
def test_an_altered_record_is_refused(command, change, finished):
    RECORDS[change](finished / "run.json")
    assert_refused(run(*COMMANDS[command]), "run")
    assert not Path("out").exists()


@pytest.mark.parametrize("pose", POSES)
def test_an_altered_pose_of_the_record_alone_is_refused(pose, finished):
    (finished / "map" / "map.recon").unlink()
    record = json.loads((finished / "run.json").read_text())
    (finished / "run.json").write_text(json.dumps({**record, "T_map_world": POSES[pose]}))
    assert_refused(run(*COMMANDS["evaluate occupancy"]), "run.json")


CONFIGS: Final = (
    b"fusion:\n  voxel_m: 0.1\n  min_",
    b"[]",
    b"\xff\xfe",
    b"fusion: {voxel_m: !!int abc}",
    b"fusion: {voxel_m: 2020-13-45}",
    b"fusion: !!python/object/apply:os.system [ls]",
    b"fusion: &a {voxel_m: *a}",
    b"occupancy: {resolution_m: .nan}",
    b"occupancy: {resolution_m: " + b"9" * 5000 + b"}",
    b"occupancy: {nothing: 1}",
    b"occupancy: [1]",
    deep(20_000)["yaml maps"].encode(),
)


@pytest.mark.parametrize("text", CONFIGS, ids=lambda text: text.decode("latin-1")[:40])
def test_an_altered_configuration_is_refused(text, finished):
    replaced(text)(finished / "config.yaml")
    assert_refused(run(*COMMANDS["occupancy"]), "config.yaml")
    assert not Path("out").exists()


@pytest.mark.parametrize("command", ["occupancy", "mesh"])
def test_a_run_of_an_older_version_is_to_be_mapped_again(command, finished):
    replaced(b"inspection: {every: 50}\n")(finished / "config.yaml")
    assert_refused(run(*COMMANDS[command]), "map the drive again")
    assert not Path("out").exists()


def record(kind: str, change: Callable[[dict[str, Any]], None] | None) -> Alter:
    """Change the first record of a kind in a map, which stays a valid file; None = delete it."""

    def alter(path: Path) -> None:
        with Store.open(path) as store:
            first = store.keys(kind)[0]
            content = store.read(kind, first, most_bytes=1 << 30)
            if change is None:
                store.delete(kind, first)
            else:
                change(content)
                store.put(kind, first, content)
            store.commit()

    return alter


def every_array(function: Callable[[np.ndarray[Any, Any]], Any]) -> Callable[[Any], None]:

    def walk(node: Any) -> None:
        items = node.items() if isinstance(node, dict) else enumerate(node)
        for key, value in list(items):
            if isinstance(value, np.ndarray):
                node[key] = function(value)
            elif isinstance(value, dict | list):
                walk(value)

    return walk


def spoil(*names: str, value: Any) -> Callable[[dict[str, Any]], None]:

    def change(state: dict[str, Any]) -> None:
        for name in names[:-1]:
            state = state[name]
        assert names[-1] in state
        state[names[-1]] = value

    return change


FILES: Final[dict[str, Alter]] = {
    "empty": replaced(b""),
    "cut in the header": cut(0.0001),
    "cut": cut(0.6),
    "another kind": replaced(b"ply\n"),
    "another database": replaced(b"SQLite format 3\0" + bytes(4000)),
    "missing": Path.unlink,
}
MAPS: Final[dict[str, Alter]] = {
    **FILES,
    "rays missing": record("rays", None),
    "rays empty": record("rays", dict.clear),
    "negative unit": record("rays", spoil("grain", "unit_m", value=-1.0)),
    "rays of another type": record("rays", every_array(lambda a: a.astype(np.float64))),
    "path no rotation": record("frames", every_array(np.ones_like)),
    "health missing": record("frames", spoil("health", value={})),
    "path missing": record("frames", None),
    "axes missing": record("axes", None),
    "axes far off": record("axes", spoil("T_map_world", value=np.array(moved(1e30)))),
    "session missing": record("session", None),
    "submap missing": record("submap", None),
    "entry missing": record("submap_entry", None),
    "entry beyond the frames": record("submap_entry", spoil("frames", value=10**6)),
}


@pytest.mark.parametrize("change", MAPS)
def test_an_altered_map_is_refused(change, finished):
    MAPS[change](finished / "map" / "map.recon")
    assert_refused(run(*COMMANDS["occupancy"]), "map.recon")
    assert not Path("out").exists()


STARTS: Final[dict[str, Alter]] = {
    **{name: change for name, change in FILES.items() if name != "missing"},
    **{
        f"{names}: {value}": record("session", spoil("start", *names, value=value))
        for names, value in (
            ((), {}),
            ((), []),
            (("identity",), []),
            (("identity",), {}),
            (("identity",), {"config": []}),
            (("identity",), {"config": {"a": 1}}),
            (("arguments",), []),
            (("arguments",), None),
            (("arguments",), {"source": 7}),
            (("arguments",), {"source": ["a"]}),
            (("arguments",), {}),
            (("arguments",), {"source": "/nonexistent"}),
            (("arguments",), {"source": "/", "kind": 7}),
            (("arguments",), {"source": "/", "prior": []}),
        )
    },
}


@pytest.mark.parametrize("change", STARTS)
def test_an_altered_start_is_refused(change, interrupted):
    STARTS[change](interrupted / STATE / STARTED)
    assert_refused(run("map", "--resume", interrupted, "--quiet"))
    assert not (interrupted / "run.json").exists()


VISUAL: Final = ("mapper", "odometry", "odometry", "last")


def state(change: Callable[[dict[str, Any]], None]) -> Alter:
    return record("state", change)


CHECKPOINTS: Final[dict[str, Alter]] = {
    "an empty tree": state(dict.clear),
    "no mapper": state(spoil("mapper", value=None)),
    "seconds are a word": state(spoil("seconds", value="many")),
    "all arrays NaN": state(every_array(lambda a: a * np.nan if a.dtype.kind == "f" else a)),
    "all arrays empty": state(every_array(lambda a: a.ravel()[:0])),
    "all arrays double": state(every_array(lambda a: a.astype(np.float64) * 1.0 + 0.5)),
    "all arrays integers": state(every_array(lambda a: np.zeros(a.shape, np.int64))),
    "map pose scaled": record("axes", spoil("T_map_world", value=2 * np.eye(4))),
    "odometry of bytes": state(spoil("mapper", "odometry", value=np.zeros(9, np.uint8))),
    "odometry pose NaN": state(
        spoil(*VISUAL, "motion", "T_world_camera", value=np.full((4, 4), np.nan))
    ),
    "odometry points flat": state(spoil(*VISUAL, "window", "xyz_world", value=np.zeros(5))),
    "frames of words": record("frames", spoil("times_s", value="many")),
    "frames missing": record("frames", None),
    "a submap missing in between": record("submap_entry", None),
    "builder empty": state(spoil("mapper", "builder", value={})),
}


@pytest.mark.parametrize("change", CHECKPOINTS)
def test_an_altered_checkpoint_is_refused(change, interrupted):
    CHECKPOINTS[change](interrupted / STATE / STARTED)
    assert_refused(run("map", "--resume", interrupted, "--quiet"), "--resume")
    assert not (interrupted / "run.json").exists()
    assert (interrupted / STATE / STARTED).exists()


def test_the_interrupted_run_can_be_resumed(interrupted):
    ended = run("map", "--resume", interrupted, "--quiet")
    assert ended.code == 0, ended.err
    assert (interrupted / "run.json").exists()
