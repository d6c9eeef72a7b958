"""Limits, signals, streams and bugs that a command meets, and options that nobody means."""

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import numpy as np
import pytest

import recon
from recon.core.errors import FormatError
from recon.core.values import PointCloud
from recon.io.models.ply import write_ply
from recon.map.store.records import Store
from recon.run.run import Run
from recon.stereo.match import registry
from tests.hostile.refusals import Ended, assert_refused, run
from tests.scenery.patience import LONG_S

PROGRAM: Final = f"PYTHONPATH={Path(recon.__file__).parents[1]} {sys.executable} -m recon"


@pytest.mark.parametrize("output", ["--help >&-", "--version > /dev/full", "--help | head -1"])
def test_an_output_that_takes_nothing_is_no_bug(output):
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", f"{PROGRAM} {output}"], capture_output=True, check=False
    )
    assert done.returncode in (0, 1)
    assert b"internal error" not in done.stderr
    assert b"Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) <= 1


@pytest.mark.parametrize("home", ["/dev/null", "", None])
def test_a_home_that_is_none_is_of_no_concern(home, here, monkeypatch):
    for name in ("MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.delenv("HOME") if home is None else monkeypatch.setenv("HOME", home)
    command = f"{PROGRAM} board chess:9x6:25mm --out board.pdf"
    done = subprocess.run(["bash", "-c", command], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert [path.name for path in here.iterdir()] == ["board.pdf"]


@pytest.mark.parametrize("folder", ["/dev/null", "/dev/null/cache", "/proc/cache"])
def test_a_cache_that_cannot_be_written_is_named(folder, pair):
    command = f"NUMBA_CACHE_DIR={folder} {PROGRAM} disparity left.png right.png --out out"
    done = subprocess.run(["bash", "-c", command], capture_output=True, check=False)
    ended = Ended(done.returncode, done.stdout.decode(), done.stderr.decode())
    assert_refused(ended, "NUMBA_CACHE_DIR", folder)
    assert not Path("out").exists()


@pytest.mark.parametrize("threads", ["0", "-1", "many", "", "\u0661"])
def test_a_number_of_threads_that_is_none_is_refused(threads, monkeypatch, here):
    monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
    assert_refused(run("map", "drive"), "NUMBA_NUM_THREADS")


@pytest.mark.parametrize("limit_mb", [200, 900, 1500])
def test_too_little_address_space_is_said_before_libraries_are_loaded(limit_mb, monkeypatch, here):
    monkeypatch.setattr(resource, "getrlimit", lambda which: (limit_mb * 1_000_000, -1))
    assert_refused(run("map", "drive"), "ulimit -v", f"{limit_mb} MB", "at least 2500 MB")


@pytest.mark.parametrize("command", [
    "capture 99999999999999999999 1 --out out",
    "capture calib.txt calib.txt --out out",
    "datasets fetch euroc --address http://[::1",
    "mesh cloud.ply --out loop",
    "localize drive --map loop --out out",
    "merge loop loop --out out",
    "map drive --out loop --resume loop",
    "merge run --georeference gnss.txt --antenna=1e300,0,0 --out out",
])  # fmt: skip
def test_a_value_that_nobody_means_is_refused(command, drive):
    Path("loop").symlink_to("loop")
    Path("calib.txt").write_text("P0: 1 0 0 0\n")
    Path("gnss.txt").write_text("0 0 0 0\n1 1 0 0\n")
    assert_refused(run(*command.split()))
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
def test_an_odd_camera_is_refused(camera, command, pair):
    source = pair if command == "pair" else ("drive",)
    for image in pair:
        (folder := Path("drive", image.stem)).mkdir(parents=True)
        for name in ("0.png", "1.png"):
            shutil.copy(image, folder / name)
    ended = run(command, *source, *camera.split(), "--quiet", "--out", "out")
    assert_refused(ended, CAMERAS[camera])
    assert not Path("out").exists()


def test_a_full_disk_at_the_beginning_leaves_nothing(here):
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


SURROUNDINGS: Final = os.environ | {"PYTHONPATH": str(Path(recon.__file__).parents[1])}


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_ended_by_a_signal_leaves_nothing(here, number):
    """As during `recon map --into`, whose new folder stands beside the old one."""
    script = f"""
import signal, time
from pathlib import Path
import recon.cli as cli
from recon.run.run import WholeRun
# Whoever runs the tests in the background may have them ignore signals.
signal.signal({int(number)}, signal.SIG_DFL)
def app():
    with WholeRun('merge', Path('run')) as run:
        run.path('file').write_text('half')
        print('ready', flush=True)
        time.sleep(600)
cli.app = app
cli.main()
"""
    command, quiet = [sys.executable, "-c", script], subprocess.DEVNULL
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=quiet, env=SURROUNDINGS
    ) as process:
        assert process.stdout.readline() == b"ready\n"
        assert (here / ".run.partial" / "file").exists()
        process.send_signal(number)
        assert process.wait(LONG_S) != 0
    assert list(here.iterdir()) == []


def test_a_signal_that_comes_where_exceptions_are_lost_comes_again():
    """As in the callback of a weak reference, in one of some ten runs."""
    script = """
import signal, time, weakref
import recon.cli as cli
signal.signal(signal.SIGINT, signal.default_int_handler)  # perhaps ignored
class Thing: pass
def gone(_):
    signal.raise_signal(signal.SIGINT)
    for _ in range(9): pass
def app():
    thing = Thing()
    weak = weakref.ref(thing, gone)
    del thing
    print('lost', flush=True)
    time.sleep(600)
cli.app = app
cli.main()
"""
    command = [sys.executable, "-c", script]
    done = subprocess.run(
        command, env=SURROUNDINGS, capture_output=True, timeout=LONG_S, check=False
    )
    assert (done.stdout, done.returncode) == (b"lost\n", -signal.SIGINT)
    assert b"ignored" not in done.stderr


def test_a_damaged_record_is_named_by_the_map_that_it_is_copied_from(here):
    with Store.create(here / "damaged") as store, Store.create(here / "new") as new:
        store.put("kind", 0, {"a": 1})
        store._database.execute("UPDATE record SET checksum = checksum + 1")
        with pytest.raises(FormatError, match="damaged: a record of the map is damaged"):
            store.copy("kind", new)


BUGS: Final = (
    ValueError("two\nlines"),
    KeyError("x"),
    TypeError("bad"),
    RecursionError("deep"),
    ModuleNotFoundError("No module named 'recon.nothing'", name="recon.nothing"),
    ImportError("cannot import name 'nothing' from 'recon'", name="recon"),
)
LACKING: Final = (
    ModuleNotFoundError("No module named 'cv2'", name="cv2"),
    ImportError("libGL.so.1: cannot open shared object file"),
    ImportError("cannot import name 'x' from 'reconnect'", name="reconnect"),
)


@pytest.mark.parametrize("error", [*BUGS, *LACKING])
@pytest.mark.parametrize("folder", ["tmp", "nonexistent"])
def test_a_bug_in_matching_is_reported_and_no_fault_of_the_file(pair, monkeypatch, error, folder):
    class Broken:
        def match(self, pair: object) -> None:
            raise error

    Path("tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(Path(folder).absolute()))
    monkeypatch.setitem(registry.MATCHERS, "fine", lambda *_: Broken())
    ended = run("disparity", *pair, "--quiet", "--out", "out")
    assert not Path("out").exists()
    if error in LACKING:
        assert_refused(ended, str(error), "recon doctor")
        return
    assert (ended.code, ended.out) == (3, "")
    (line,) = ended.lines
    found = re.fullmatch(r"error: internal error \((.*)\), please report: (\S+)", line)
    if folder == "nonexistent":
        assert "TMPDIR" in line
    else:
        assert found[1].startswith(type(error).__name__)
        assert re.search(r"(?s)Traceback.*in match", Path(found[2]).read_text())


@pytest.mark.parametrize(
    "command",
    ["cv2 pair a b", "numba map drive", "open3d mesh cloud.ply", "rich settings", "typer --help"],
)
def test_a_command_names_the_package_that_it_lacks(command, here):
    package, *words = command.split()
    lacking = (
        f"import sys; sys.modules[{package!r}] = None; from recon.__main__ import main; "
        f"sys.argv = ['recon', *{words!r}]; main()"
    )
    (here / "drive").mkdir()
    write_ply(here / "cloud.ply", PointCloud(np.random.default_rng(0).random((200, 3), np.float32)))
    done = subprocess.run([sys.executable, "-c", lacking], capture_output=True, check=False)
    assert_refused(Ended(done.returncode, done.stdout.decode(), done.stderr.decode()), package)


def test_no_module_can_run_what_it_reads():
    modules = "pickle|marshal|shelve|dill|joblib"
    danger = (
        rf"import.*({modules})|allow_pickle=[^F]|yaml\.\w*(?<!safe_)load|torch\.load|[^.\w]eval\("
    )
    files = [*Path(recon.__file__).parent.rglob("*.py")]
    assert len(files) > 200
    assert not [path for path in files if re.search(danger, path.read_text())]
