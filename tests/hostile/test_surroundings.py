"""Limits, signals and streams that a command meets, and options with values that nobody means."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

import recon
from recon.commands.config import load_config
from recon.commands.demo import demo_source
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import FormatError, MemoryLimitError
from recon.map.store.records import Store
from recon.run.run import Run
from tests.hostile.refusals import assert_refused, run
from tests.hostile.runs import DRIVE
from tests.scenery.patience import LONG_S

PROGRAM: Final = f"PYTHONPATH={Path(recon.__file__).parents[1]} {sys.executable} -m recon"


@pytest.mark.parametrize("output", ["--help >&-", "--version > /dev/full", "--help | head -1"])
def test_an_output_that_takes_nothing_is_no_bug(output: str) -> None:
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", f"{PROGRAM} {output}"], capture_output=True, check=False
    )
    assert done.returncode in (0, 1)
    assert b"internal error" not in done.stderr
    assert b"Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) <= 1


@pytest.mark.parametrize("threads", ["0", "-1", "many", "", "\u0661"])
def test_a_number_of_threads_that_is_none_is_refused(
    threads: str, monkeypatch: pytest.MonkeyPatch, here: Path
) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    assert_refused(run("map", "drive"), "NUMBA_NUM_THREADS")


@pytest.mark.parametrize("limit_mb", [200, 900, 1500])
def test_too_little_address_space_is_said_before_libraries_are_loaded(
    limit_mb: int, monkeypatch: pytest.MonkeyPatch, here: Path
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda which: (limit_mb * 1_000_000, -1))
    assert_refused(run("map", "drive"), "ulimit -v", f"{limit_mb} MB", "at least 2500 MB")


OPTIONS: Final = {
    "a device of twenty digits": ("capture", "99999999999999999999", "1", "--out", "out"),
    "a text as a video": ("capture", "calib.txt", "calib.txt", "--out", "out"),
    "half an address": ("datasets", "fetch", "euroc", "--address", "http://[::1"),
    "a loop as --out": ("mesh", "cloud.ply", "--out", "loop"),
    "a loop as --map": ("localize", "drive", "--map", "loop", "--out", "out"),
    "a loop to merge": ("merge", "loop", "loop", "--out", "out"),
    "a loop as both folders": ("map", "drive", "--out", "loop", "--resume", "loop"),
    "an antenna far away": (
        "merge", "run", "--georeference", "gnss.txt", "--antenna=1e300,0,0", "--out", "out",
    ),
}  # fmt: skip


@pytest.mark.parametrize("option", OPTIONS)
def test_a_value_that_nobody_means_is_refused(option: str, here: Path, drive: Path) -> None:
    Path("loop").symlink_to("loop")
    Path("calib.txt").write_text("P0: 1 0 0 0\n")
    Path("gnss.txt").write_text("0 0 0 0\n1 1 0 0\n")
    assert_refused(run(*OPTIONS[option]))
    assert not Path("out").exists()


CAMERAS: Final = {
    "--focal 1e9 --baseline 0.5": "focal",
    "--focal 1e-9 --baseline 0.5": "focal",
    "--focal nan --baseline 0.5": "focal",
    "--focal 1e6 --baseline 0.5": "focal",
    "--focal 1 --baseline 0.5": "focal",
    "--focal 40 --baseline 1e300": "baseline",
    "--focal 40 --baseline 1e-300": "baseline",
    "--focal 40 --baseline inf": "baseline",
    "--focal 40 --baseline 1e6": "baseline",
    "--focal 40 --baseline 0.5 --cx 1e300": "cx_px",
    "--focal 40 --baseline 0.5 --cy 1e6": "principal point",
}


@pytest.mark.parametrize("command", ["pair", "map", "audit", "live"])
@pytest.mark.parametrize("camera", CAMERAS)
def test_a_camera_that_nobody_has_is_refused(
    camera: str, command: str, pair: tuple[Path, Path]
) -> None:
    left, right = pair
    source = [left, right] if command == "pair" else ["drive"]
    for side, image in (("left", left), ("right", right)):
        for name in ("0.png", "1.png"):
            (target := Path("drive", side, name)).parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(image.read_bytes())
    ended = run(command, *source, *camera.split(), "--quiet", "--out", "out")
    assert_refused(ended, CAMERAS[camera])
    assert not Path("out").exists()


def test_a_full_disk_at_the_beginning_leaves_nothing(here: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        with pytest.raises(OSError, match="too large") as failed, Run("map", here / "out"):
            (here / "out" / ".partial" / "file").write_text("more than nothing")
        ended = run("demo", "--out", here / "out", "--frames", "4", "--quiet")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert failed.value.errno
    assert_refused(ended, "File too large")
    assert list(here.iterdir()) == []


def test_a_demo_that_cannot_be_resumed_does_not_advise_it(here: Path) -> None:
    config = load_config(None, [f"street.{key}={value}" for key, value in DRIVE.items()])
    config = config.model_copy(update={"memory": config.memory.model_copy(update={"limit_mb": 1})})
    options = MapOptions(command="demo", out=here / "out", audit=False, mesh=False)
    with pytest.raises(MemoryLimitError) as told:
        run_map(demo_source(config), config, options)
    assert "--resume" not in str(told.value)
    assert list(here.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_ended_by_a_signal_leaves_nothing(here: Path, number: int) -> None:
    """As during `recon map --into`, whose new folder stands beside the old one."""
    script = (
        "import signal, time\nfrom pathlib import Path\nimport recon.cli as cli\n"
        "from recon.run.run import WholeRun\n"
        # Whoever runs the tests in the background may have them ignore signals.
        f"signal.signal({int(number)}, signal.SIG_DFL)\n"
        "def app():\n"
        "    with WholeRun('merge', Path('run')) as run:\n"
        "        run.path('file').write_text('half')\n"
        "        print('ready', flush=True)\n"
        "        time.sleep(600)\n"
        "cli.app = app\ncli.main()\n"
    )
    surroundings = os.environ | {"PYTHONPATH": str(Path(recon.__file__).parents[1])}
    with subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=surroundings,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        assert (here / ".run.partial" / "file").exists()
        process.send_signal(number)
        assert process.wait(LONG_S) != 0
    assert list(here.iterdir()) == []


def test_a_signal_that_comes_where_exceptions_are_lost_comes_again() -> None:
    """As in the callback of a weak reference, in one of some ten runs."""
    script = (
        "import signal, time, weakref\nimport recon.cli as cli\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # perhaps ignored
        "class Thing: pass\n"
        "def gone(_):\n"
        "    signal.raise_signal(signal.SIGINT)\n"
        "    for _ in range(9): pass\n"
        "def app():\n"
        "    thing = Thing()\n"
        "    weak = weakref.ref(thing, gone)\n"
        "    del thing\n"
        "    print('lost', flush=True)\n"
        "    time.sleep(600)\n"
        "cli.app = app\ncli.main()\n"
    )
    surroundings = os.environ | {"PYTHONPATH": str(Path(recon.__file__).parents[1])}
    command = [sys.executable, "-c", script]
    done = subprocess.run(
        command, env=surroundings, capture_output=True, timeout=LONG_S, check=False
    )
    assert (done.stdout, done.returncode) == (b"lost\n", -signal.SIGINT)
    assert b"ignored" not in done.stderr


def test_a_damaged_record_is_named_by_the_map_that_it_is_copied_from(here: Path) -> None:
    with Store.create(here / "damaged") as store, Store.create(here / "new") as new:
        store.put("kind", 0, {"a": 1})
        store._database.execute("UPDATE record SET checksum = checksum + 1")
        with pytest.raises(FormatError, match="damaged: a record of the map is damaged"):
            store.copy("kind", new)
