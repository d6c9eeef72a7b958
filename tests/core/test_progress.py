"""What a run says while it works: to whoever watches, else to a logger."""

import itertools
import logging
import subprocess
import sys
import threading

import pytest

from recon.core import progress
from recon.core.progress import Silent, series, showing, stage, tracked

pytestmark = pytest.mark.portable


class Noted(Silent):
    def __init__(self):
        self.said = []

    def on_start(self, name, total, unit="frames"):
        self.said.append((name, total, unit))

    def on_step(self, step):
        self.said.append(step.event["event"])

    def on_stage(self, name):
        self.said.append(name)

    def on_finish(self):
        self.said.append("end")


def test_who_watches_is_told_of_work_that_nothing_was_handed_down_to():
    noted = Noted()
    with showing(noted):
        stage("mesh")
        assert list(tracked([4, 5], "tiles")) == [4, 5]
        assert list(tracked(iter([6]), "images", "read", total=1)) == [6]
        assert list(tracked(iter([]), "pairs")) == []
    stage("unheard")
    of_tiles = [("mesh", 2, "tiles"), "step", "step", "end"]
    assert noted.said == ["mesh", *of_tiles, ("read", 1, "images"), "step", "end",
                          ("mesh", 0, "pairs"), "end"]  # fmt: skip


def test_a_series_ends_where_its_items_fail_or_are_left_alone():
    noted = Noted()
    with showing(noted):
        with pytest.raises(OSError, match="torn"), series("read", 2):
            raise OSError("torn")
        items = tracked([1, 2], "tiles", "cut")
        assert next(items) == 1
        items.close()
    assert noted.said == [("read", 2, "frames"), "end", ("cut", 2, "tiles"), "end"]


def test_threads_do_not_share_who_is_told():
    noted = Noted()
    with showing(noted):
        other = threading.Thread(target=stage, args=["elsewhere"])
        other.start()
        other.join()
    assert noted.said == []


def test_a_log_has_stages_and_counts_of_what_lasts(caplog, monkeypatch):
    now = itertools.count(0.0, 0.5)
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    caplog.set_level(logging.INFO, "recon")
    stage("mesh")
    assert len(list(tracked(range(6), "tiles"))) == 6
    told = [record.getMessage().strip() for record in caplog.records]
    assert told[:2] == ["mesh", "mesh: 6 tiles"]
    assert told[2:] == [f"mesh: {done} of 6 tiles" for done in (2, 4, 6)]


COMPILES = """
from recon.core.kernels.cache import announce
for name in "ab":
    announce(name)
"""


def test_python_says_once_that_kernels_are_compiled():
    done = subprocess.run(
        [sys.executable, "-c", COMPILES], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr.count("compiling kernels, once after an installation") == 1
