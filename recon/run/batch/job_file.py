"""The file that lists the jobs of a batch, in TOML or YAML; docs/many-drives.md has one."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import ConfigDict, Field, ValidationError, field_validator

from recon.core.errors import FormatError, SettingsError
from recon.core.settings import Settings, settings_error
from recon.io.atomic import write_text
from recon.io.fields import read_toml, read_yaml
from recon.io.files import read_text, reading, resolved
from recon.run.batch.job import LOGS

SUFFIXES: Final = (".toml", ".yaml", ".yml")
PLAN: Final = "jobs.json"  # the jobs of a batch, in its folder from the first moment
_PLAN_BYTES: Final = 1 << 28
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.=+-]{0,119}")
_FILES: Final = frozenset(
    (PLAN, LOGS, "run.json", "summary.json", "config.yaml", "report.html", "table.csv", "table.md",
     "table.tex", "sweep.png", "time.png")
)  # fmt: skip
"""What a batch writes beside the folders of its jobs."""
_MOST_JOBS: Final = 1_000_000
_Value = str | bool | int | Annotated[float, Field(allow_inf_nan=False)]


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


class JobList(Settings):
    """What a batch is asked for: jobs below a folder, each with all combinations of a sweep."""

    model_config = ConfigDict(strict=True)

    job: list[Entry] = Field(min_length=1)
    sweep: dict[str, Annotated[list[_Value], Field(min_length=1)]] = Field({})
    folder: str = ""

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

        return self.model_copy(update={"job": [limited(one) for one in self.job]})

    def write(self, folder: Path) -> None:
        write_text(folder / PLAN, self.model_dump_json(exclude_defaults=True))


def read_jobs(path: Path) -> JobList:
    """Read a job file."""
    content = read_toml(path) if path.suffix.lower() == ".toml" else read_yaml(path)
    folder = path.parent / str(content.get("folder", ""))
    return _job_list({**content, "folder": str(resolved(folder))}, path)


def read_plan(folder: Path) -> JobList:
    """Read the jobs of a batch that was begun."""
    path = folder / PLAN
    if not path.is_file():
        raise FormatError("folder holds no batch", where=folder, expected=f"a {PLAN}")
    with reading(path):
        content = json.loads(read_text(path, _PLAN_BYTES))
        return _job_list(content, path)


def _job_list(content: Any, path: Path) -> JobList:
    try:
        listed = JobList.model_validate(content)
    except ValidationError as error:
        hint = f"a file has job and sweep, a job has {', '.join(Entry.model_fields)}"
        raise settings_error(error, where=str(path)).copy_with(hint=hint) from error
    count = len(listed.job) * math.prod(map(len, listed.sweep.values()))
    if count > _MOST_JOBS:
        raise SettingsError("too many jobs", where=path, got=count)
    return listed


def jobs_of_sources(command: str, sources: Sequence[str]) -> JobList:
    """Return one job for each source, named by as many last parts as tell all apart."""
    if not sources:
        raise SettingsError("there is no source", where=f"recon batch {command}")
    paths = [resolved(source).parts[1:] for source in sources]
    for count in range(1, max(map(len, paths)) + 1):
        names = [_name_of(parts[-count:]) for parts in paths]
        if len({name.lower() for name in names}) == len(names):
            break
    else:  # the same source twice: `check_names` says so
        names = [_name_of(parts[-1:]) for parts in paths]
    named = zip(names, sources, strict=True)
    jobs = [Entry(name=name, command=command, source=[one]) for name, one in named]
    return JobList(job=jobs, folder=str(Path.cwd()))


def check_names(names: Iterable[str]) -> None:
    """Check that each job has a folder of its own, below that of the batch."""
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


def _plain(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.+-]", "-", text)


def _name_of(parts: Sequence[str]) -> str:
    """Return parts of a path as one name, without what a folder cannot be named by."""
    return re.sub(r"^[^A-Za-z0-9]+", "", _plain("_".join(parts))) or "job"
