"""Jobs for tests: a stand-in for the program, and what it is told to do."""

from pathlib import Path
from typing import Any

from recon.run.batch.job import Job

#: What `recon` would do, without what it needs to start: `… map WHAT --out FOLDER …`.
STAND_IN = """
import json, os, signal, sys, time
from pathlib import Path
words = sys.argv[1:]
resumed = "--resume" in words
out = Path(words[words.index("--resume" if resumed else "--out") + 1])
what = (out / ".partial" / "what").read_text() if resumed else words[1]
out.mkdir(parents=True, exist_ok=True)
with (out.parent / f"{out.name}.tries").open("a") as file:
    file.write("resumed " if resumed else "begun ")
def begin():
    state = out / ".partial" / ".state"
    state.mkdir(parents=True, exist_ok=True)
    (state / "map.recon").write_text("x")
    (out / ".partial" / "what").write_text(what)
def finish():
    (out / "summary.json").write_text(json.dumps({"points": 7, "seconds": 1.0, "warnings": []}))
    (out / "run.json").write_text("{}")
if what == "good":
    print(json.dumps({"event": "start", "frames": 2}), file=sys.stderr)
    print(json.dumps({"event": "frame", "index": 1}), file=sys.stderr)
    finish()
elif what == "bad":
    sys.exit("error: nowhere: folder does not exist")
elif what == "boxed":
    sys.exit("╭─ Error ─╮\\n│ No such option: --x │\\n╰─────────╯")
elif what == "says much":
    for n in range(1000):
        print(json.dumps({"event": "frame", "index": n}), file=sys.stderr)
    print("warning: the lens is dirty", file=sys.stderr)
    finish()
elif what == "killed once" and not resumed:
    begin()
    os.kill(os.getpid(), signal.SIGKILL)
elif what == "killed once":
    finish()
elif what == "always killed":
    os.kill(os.getpid(), signal.SIGKILL)
elif what == "damaged":
    begin()
    sys.exit("error: damaged")
elif what == "endless":
    (out.parent / f"{out.name}.pid").write_text(str(os.getpid()))
    time.sleep(600)
"""


def job(name: str, what: str = "good", **changes: Any) -> Job:
    values = {"folder": ".", "writes": True, **changes}
    return Job(name, "map", what, ("map", what), **values)


def tries(folder: Path, name: str) -> list[str]:
    return (folder / f"{name}.tries").read_text().split()
