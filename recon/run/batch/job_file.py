"""The file that lists the jobs of a batch, in TOML or YAML.

::

    [sweep]                                  optional: every job with each of these values
    "matching.sad.window_px" = [9, 11, 13]

    [[job]]
    name = "monday"                          the folder of its result
    command = "map"                          any command that writes results
    source = "drives/monday"                 or several: ["left.png", "right.png"]; none for demo
    options = ["--no-mesh"]                  optional, like all below
    set = ["odometry.method=visual"]
    threads = 2
    memory = "4G"                            of `recon map`: its --memory-limit
    timeout_s = 3600
    retries = 2

Relative paths begin in the folder of the file.
"""

from __future__ import annotations

import difflib
import itertools
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from pydantic import ConfigDict, Field, field_validator

from recon.core.errors import FormatError, SettingsError
from recon.core.settings import Settings
from recon.io.atomic import write_text
from recon.io.files import read_text, reading
from recon.io.toml_file import read_toml
from recon.io.yaml_file import read_yaml
from recon.run.batch.job import LOGS

SUFFIXES: Final = (".toml", ".yaml", ".yml")
PLAN: Final = "jobs.json"
"""The jobs of a batch, in its folder from the first moment."""
_PLAN_BYTES: Final = 1 << 28
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.=+-]{0,119}")
_FILES: Final = frozenset(
    (PLAN, LOGS, "run.json", "summary.json", "config.yaml", "report.html", "table.csv", "table.md",
     "sweep.png")
)  # fmt: skip
"""What a batch writes beside the folders of its jobs."""
_MOST_JOBS: Final = 1_000_000


class Entry(Settings):
    """A job as it is asked for; None = as the batch says."""

    model_config = ConfigDict(strict=True)

    name: str
    command: str
    source: list[str] = Field([])
    options: list[str] = Field([])
    set: list[str] = Field([])
    threads: int | None = Field(None, ge=1)
    memory: str | None = None
    timeout_s: float | None = Field(None, ge=1e-3, allow_inf_nan=False)
    retries: int | None = Field(None, ge=0)

    @field_validator("source", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        return [value] if isinstance(value, str) else value


@dataclass(frozen=True)
class JobList:
    """What a batch is asked for.

    Attributes:
        jobs: Its jobs, each with all combinations of the sweep.
        sweep: Values by the name of the setting.
        folder: Where relative paths begin.
    """

    jobs: Sequence[Entry]
    sweep: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    folder: Path = field(default_factory=Path.cwd)

    def combinations(self) -> Iterator[dict[str, Any]]:
        """Yield the settings of each combination of the sweep; one without any if there is none."""
        for values in itertools.product(*self.sweep.values()):
            yield dict(zip(self.sweep, values, strict=True))

    def with_limits(
        self, settings: Sequence[str], options: Sequence[str], **limits: Any
    ) -> JobList:
        """Return it with settings and options before those of each job, and missing limits."""

        def limited(one: Entry) -> Entry:
            missing = {key: value for key, value in limits.items() if getattr(one, key) is None}
            lists = {"set": [*settings, *one.set], "options": [*options, *one.options]}
            return one.model_copy(update={**lists, **missing})

        return replace(self, jobs=[limited(one) for one in self.jobs])

    def write(self, folder: Path) -> None:
        """Write it into the folder of its batch.

        Raises:
            OutputError: The folder cannot be written.
        """
        jobs = [one.model_dump(exclude_defaults=True) for one in self.jobs]
        plan = {"folder": str(self.folder.resolve()), "sweep": self.sweep, "job": jobs}
        write_text(folder / PLAN, json.dumps(plan))


def read_jobs(path: Path) -> JobList:
    """Read a job file.

    Raises:
        FormatError: The file cannot be read.
        SettingsError: A key is unknown or missing, or a value is of a wrong kind.
    """
    content = read_toml(path) if path.suffix.lower() == ".toml" else read_yaml(path)
    return _job_list(content, path)


def _job_list(content: Mapping[str, Any], path: Path) -> JobList:
    _check_keys(content, ("job", "sweep", *(("folder",) if path.name == PLAN else ())), str(path))
    listed, sweep = content.get("job"), content.get("sweep", {})
    if not isinstance(listed, list) or not listed:
        expected = "[[job]] with name, command, source"
        raise SettingsError("there is no job", where=path, expected=expected)
    _check_sweep(sweep, len(listed), str(path))
    jobs = [_entry(one, f"{path}: job {n}") for n, one in enumerate(listed, start=1)]
    return JobList(jobs, sweep, Path(str(content.get("folder", path.parent))))


def read_plan(folder: Path) -> JobList:
    """Read the jobs of a batch that was begun.

    Raises:
        FormatError: The folder is not one of a batch, or its jobs cannot be read.
    """
    path = folder / PLAN
    if not path.is_file():
        raise FormatError("folder holds no batch", where=folder, expected=f"a {PLAN}")
    with reading(path):
        content = json.loads(read_text(path, _PLAN_BYTES))
        if isinstance(content, list):
            hint = "start it again with another --out"
            raise FormatError("batch of an earlier version", where=path, hint=hint)
        return _job_list(content, path)


def jobs_of_sources(command: str, sources: Sequence[str]) -> JobList:
    """Return one job for each source, named by its last part.

    Where two would have one name, each is named by as many of the last parts as tell all apart.

    Raises:
        SettingsError: There is no source.
    """
    if not sources:
        raise SettingsError("there is no source", where=f"recon batch {command}")
    names = zip(_names_of(sources), sources, strict=True)
    return JobList([Entry(name=name, command=command, source=[one]) for name, one in names])


def check_names(names: Iterable[str]) -> None:
    """Check that each job has a folder of its own, below that of the batch.

    Raises:
        SettingsError: A name is none, or stands there twice.
    """
    seen = set[str]()
    for name in names:
        where, small = f"job {name}", name.lower()  # on some file systems they are the same
        if not _NAME.fullmatch(name):
            expected = "letters, digits and _ . = + -, beginning with a letter or digit"
            raise SettingsError("not a name of a folder", where=where, expected=expected)
        if small in _FILES:
            raise SettingsError("name of a job is that of a file of the batch", where=where)
        if small in seen:
            hint = "if they are two jobs, name them in a file of jobs"
            raise SettingsError("two jobs have one name", where=where, hint=hint)
        seen.add(small)


def name_of_swept(name: str, swept: Mapping[str, Any]) -> str:
    """Return the name of a job with swept settings."""
    ends = (f"_{key.rpartition('.')[2]}={_plain(str(value))}" for key, value in swept.items())
    return name + "".join(ends)


def _entry(content: Any, where: str) -> Entry:
    if not isinstance(content, Mapping):
        raise SettingsError("job is not a table", where=where, got=type(content).__name__)
    _check_keys(content, tuple(Entry.model_fields), where)
    return Entry.parse(content, where=where)


def _check_sweep(sweep: Any, jobs: int, where: str) -> None:
    if not isinstance(sweep, Mapping) or not all(
        isinstance(values, list) and values and all(map(_is_plain, values))
        for values in sweep.values()
    ):
        expected = '"matching.sad.window_px" = [9, 11, 13]'
        raise SettingsError("sweep is not a table of lists", where=where, expected=expected)
    if (count := jobs * math.prod(map(len, sweep.values()))) > _MOST_JOBS:
        raise SettingsError("too many jobs", where=where, got=count)


def _is_plain(value: Any) -> bool:
    return isinstance(value, str) or (isinstance(value, int | float) and math.isfinite(value))


def _check_keys(content: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    for key in content:
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1)
            hint, expected = f"did you mean {near[0]}?" if near else None, ", ".join(known)
            raise SettingsError("unknown key", where=where, got=key, expected=expected, hint=hint)


def _plain(text: str) -> str:
    """Return a text as part of the name of a folder."""
    return re.sub(r"[^A-Za-z0-9_.+-]", "-", text)


def _names_of(sources: Sequence[str]) -> list[str]:
    """Return names of sources, by as many last parts of their paths as tell all apart."""
    paths = [Path(source).resolve().parts[1:] for source in sources]
    for count in range(1, max(map(len, paths)) + 1):
        names = [_name_of(parts[-count:]) for parts in paths]
        if len({name.lower() for name in names}) == len(names):
            return names
    return [_name_of(parts[-1:]) for parts in paths]


def _name_of(parts: Sequence[str]) -> str:
    """Return parts of a path as one name, without what a folder cannot be named by."""
    return re.sub(r"^[^A-Za-z0-9]+", "", _plain("_".join(parts))) or "job"
