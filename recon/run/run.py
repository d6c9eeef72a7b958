"""What every command shares: a result folder with configuration, summary and record; times."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from datetime import datetime, timezone
from functools import cached_property
from pathlib import Path
from typing import Any, Final, TypeVar

from typing_extensions import Self

from recon.core import progress
from recon.core.errors import OutputError
from recon.core.machine import peak_memory_mb, versions
from recon.core.settings import Settings
from recon.core.summary import RunSummary
from recon.core.text import counted
from recon.core.work import Stopwatch, use_threads
from recon.io.fields import write_yaml
from recon.io.files import StrPath, fingerprint, read_text, reading, resolved
from recon.run.directory import RECORD, STARTED, RunDirectory, default_folder, recorded_files

CONFIG: Final = "config.yaml"
SUMMARY: Final = "summary.json"
_MAP: Final = Path("map", STARTED)
_MAPPING: Final = ("map", "demo", "live", "merge", "piece")  # a map in place of another
Summary = TypeVar("Summary", bound=RunSummary)


class Run(RunDirectory):
    """One run of a command, as a context manager.

    It writes ``config.yaml`` at the start; `finish` writes ``summary.json`` and ``run.json``; all
    files appear in the folder when the body of the ``with`` statement has ended without an error::

        with Run("pair", out, config) as run:
            with run.stage("match"):
                write_pfm(run.path("disparity/disparity.pfm"), match(pair))
            with run.report(summary) as summary:
                write_pair_page(replace(result, summary=summary), run)
            summary = run.finish(summary, source="im0.png", inputs=files)

    ``out`` None is a new folder below ``outputs/<command>/``, ``threads`` None all cores.
    """

    def __init__(
        self,
        command: str,
        out: StrPath | None = None,
        config: Settings | None = None,
        *,
        threads: int | None = None,
        resume: bool = False,
    ) -> None:
        standard = default_folder(command)
        folder = standard if out is None else Path(out)
        # A run in a default folder keeps its link when it is resumed.
        stamped = out is not None and resolved(folder.parent) == resolved(standard.parent)
        super().__init__(folder, latest=out is None or (resume and stamped), resume=resume)
        self.command = command
        self.threads = use_threads(threads)
        self.watch = Stopwatch()
        self._config = config
        self._start = time.perf_counter()

    def __enter__(self) -> Self:
        if not self.resumes and _MAP in recorded_files(self.folder):
            self._refuse_to_lose_map()
        super().__enter__()
        try:
            if self._config is not None:
                self.write_config(self._config)
        except BaseException:  # such as a full disk
            self.__exit__(*sys.exc_info())
            raise
        return self

    def _refuse_to_lose_map(self) -> None:
        """Refuse results in place of a map that is none of theirs, or of several drives."""
        with reading(path := self.folder / SUMMARY):
            drives = len(json.loads(read_text(path)).get("sessions", ())) or 1
        if self.command not in _MAPPING or (drives > 1 and not self.whole):
            what, got = "the results would replace a map", f"one of {counted(drives, 'drive')}"
            hint = "another --out; recon map --into adds a drive"
            raise OutputError(what, where=self.folder, got=got, hint=hint)

    def write_config(self, config: Settings) -> None:
        """Write ``config.yaml``, anew where some settings are known only now."""
        write_yaml(self.path(CONFIG), config.recorded(self.command))

    def stage(self, name: str) -> AbstractContextManager[None]:
        """Time the body of a ``with`` statement as part of the stage ``name``, and say it."""
        progress.stage(name)
        return self.watch.stage(name)

    @contextmanager
    def report(self, summary: Summary) -> Iterator[Summary]:
        """Time the writing of the report, which is given the summary with the cost of the run."""
        complete = replace(summary, **self._cost)
        with self.stage("report"):
            yield complete

    def finish(
        self,
        summary: Summary,
        *,
        source: str,
        inputs: Iterable[Path],
        record: Mapping[str, Any] | None = None,
    ) -> Summary:
        """Write ``summary.json`` and ``run.json``, the last thing that a run does.

        The record gets a hash of the inputs, and what else there is to ``record``. Returned is the
        summary with the cost of the run and its folder.
        """
        inputs = tuple(inputs)
        self.check_targets(inputs)
        complete = replace(summary, **self._cost, out=str(self.folder))
        self.write_json(SUMMARY, complete.to_json())
        with self.stage("hash"):
            hashed = fingerprint(inputs)
        self.write_json(
            RECORD,
            {
                "command": self.command,
                "finished_utc": datetime.now(timezone.utc).isoformat(timespec="seconds"),
                "versions": versions(),
                "source": source,
                "inputs": hashed,
                "timings": self._timings(),
                "peak_memory_mb": complete.peak_memory_mb,
                "warnings": list(complete.warnings),
                **(record or {}),
                # Last, since it lists all files.
                "files": [*self.files(), RECORD],
            },
        )
        return complete

    @cached_property
    def _cost(self) -> Mapping[str, Any]:
        """Seconds in all and per stage, and peak memory, taken once."""
        return {
            "seconds": round(time.perf_counter() - self._start, 3),
            "stages": self._timings(),
            "peak_memory_mb": round(peak_memory_mb(), 1),
        }

    def _timings(self) -> dict[str, float]:
        return {name: round(value, 3) for name, value in self.watch.seconds.items()}


class WholeRun(Run):
    """A run whose folder appears, or takes the place of an earlier one, in one step."""

    whole = True
