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
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

from recon.core.errors import SettingsError
from recon.io.toml_file import read_toml
from recon.io.yaml_file import read_yaml

SUFFIXES: Final = (".toml", ".yaml", ".yml")
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.=+-]{0,119}")
_FILES: Final = frozenset(
    ("jobs.json", "run.json", "summary.json", "config.yaml", "report.html", "table.csv",
     "table.md", "sweep.png")
)  # fmt: skip
"""What a batch writes beside the folders of its jobs."""
_MOST_JOBS: Final = 1_000_000
_KEYS: Final = ("job", "sweep")


@dataclass(frozen=True)
class Entry:
    """A job as it is asked for.

    Attributes:
        name: Its name.
        command: The command, such as ``map`` or ``evaluate trajectory``.
        source: What the command works on, in the order of its arguments; empty = it needs nothing.
        options: Further words of the command line.
        set: Settings, as ``key=value``.
        threads: Threads of its process; None = as the batch says.
        memory: Memory limit, such as ``4G``; None = as the batch says.
        timeout_s: Longest time of one try; None = as the batch says.
        retries: Tries after the first that broke; None = as the batch says.
        swept: Settings that a sweep adds.
    """

    name: str
    command: str
    source: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    set: tuple[str, ...] = ()
    threads: int | None = None
    memory: str | None = None
    timeout_s: float | None = None
    retries: int | None = None
    swept: Mapping[str, Any] = field(default_factory=dict)


_JOB_KEYS: Final = tuple(one.name for one in fields(Entry) if one.name != "swept")


def read_jobs(path: Path, settings: Sequence[str] = (), options: Sequence[str] = ()) -> list[Entry]:
    """Read a job file, with its sweep spread out.

    Args:
        path: The file.
        settings: Further settings of each job, before its own.
        options: Further options of each job.

    Raises:
        FormatError: The file cannot be read.
        SettingsError: A key is unknown or missing, a value is of a wrong kind, or a name is no
            name of a folder or stands there twice.
    """
    content = read_toml(path) if path.suffix.lower() == ".toml" else read_yaml(path)
    _check_keys(content, _KEYS, str(path))
    listed = content.get("job")
    if not isinstance(listed, list) or not listed:
        raise SettingsError(
            "there is no job", where=path, expected="[[job]] with name, command, source"
        )
    entries = [_entry(one, f"{path}: job {n}") for n, one in enumerate(listed, start=1)]
    entries = [
        replace(one, set=(*settings, *one.set), options=(*options, *one.options)) for one in entries
    ]
    spread = spread_sweep(entries, content.get("sweep", {}), str(path))
    check_names(spread, str(path))
    return spread


def jobs_of_sources(
    command: str, sources: Sequence[str], options: Sequence[str], settings: Sequence[str]
) -> list[Entry]:
    """Return one job for each source, named by its last part.

    Where two would have one name, each is named by as many of the last parts as tell all apart.

    Raises:
        SettingsError: There is no source, or two are the same.
    """
    if not sources:
        raise SettingsError("there is no source", where=f"recon batch {command}")
    entries = [
        Entry(name, command, (source,), tuple(options), tuple(settings))
        for name, source in zip(_names_of(sources), sources, strict=True)
    ]
    check_names(entries, f"recon batch {command}")
    return entries


def spread_sweep(entries: Sequence[Entry], sweep: Any, where: str) -> list[Entry]:
    """Return each job with each combination of the values of a sweep.

    Args:
        entries: The jobs.
        sweep: Lists of values, by the name of the setting.
        where: The file, for error messages.

    Raises:
        SettingsError: It is not a table of lists, or gives too many jobs.
    """
    plain = (str, int, float, bool)
    if not isinstance(sweep, Mapping) or not all(
        isinstance(values, list) and values and all(isinstance(v, plain) for v in values)
        for values in sweep.values()
    ):
        expected = '"matching.sad.window_px" = [9, 11, 13]'
        raise SettingsError("sweep is not a table of lists", where=where, expected=expected)
    combinations = 1
    for values in sweep.values():
        combinations *= len(values)
    if combinations * len(entries) > _MOST_JOBS:
        raise SettingsError("too many jobs", where=where, got=combinations * len(entries))
    return list(_spread(entries, sweep))


def check_names(entries: Sequence[Entry], where: str) -> None:
    """Check that each job has a folder of its own, below that of the batch.

    Raises:
        SettingsError: A name is none, or stands there twice.
    """
    seen: dict[str, str] = {}
    for entry in entries:
        if not _NAME.fullmatch(entry.name):
            expected = "letters, digits and _ . = + -, beginning with a letter or digit"
            raise SettingsError(
                "name of a job is not a name of a folder",
                where=where,
                got=repr(entry.name),
                expected=expected,
            )
        if entry.name.lower() in _FILES:
            raise SettingsError(
                "name of a job is that of a file of the batch", where=where, got=entry.name
            )
        # On some file systems, capital and small letters are the same.
        if entry.name.lower() in seen:
            hint = "if they are two jobs, name them in a file of jobs"
            raise SettingsError("two jobs have one name", where=where, got=entry.name, hint=hint)
        seen[entry.name.lower()] = entry.name


def _entry(content: Any, where: str) -> Entry:
    if not isinstance(content, Mapping):
        raise SettingsError("job is not a table", where=where, got=type(content).__name__)
    _check_keys(content, _JOB_KEYS, where)
    for key in ("name", "command"):
        if key not in content:
            raise SettingsError(f"job has no {key}", where=where)
    values = {key: _value(key, value, where) for key, value in content.items()}
    return Entry(**values)


def _value(key: str, value: Any, where: str) -> Any:
    """Return the value of a key, checked; lists become tuples."""
    many, number = key in ("source", "options", "set"), key in ("threads", "retries", "timeout_s")
    if many and isinstance(value, list) and all(isinstance(one, str) for one in value):
        right = bool(value) or key != "source"
        value = tuple(value)
    elif number:
        kinds = (int, float) if key == "timeout_s" else (int,)
        right = type(value) in kinds and value >= (0 if key == "retries" else 1e-3)
    else:
        right = isinstance(value, str) and (key == "source" or not many)
        value = (value,) if many else value
    if not right:
        expected = "a list of texts" if many else "a number" if number else "a text"
        raise SettingsError(f"{key} is not {expected}", where=where, got=repr(value))
    return value


def _check_keys(content: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    for key in content:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean {near[0]}?" if near else None
            raise SettingsError(
                "unknown key", where=where, got=key, expected=", ".join(known), hint=hint
            )


def _spread(entries: Sequence[Entry], sweep: Mapping[str, Sequence[Any]]) -> Iterator[Entry]:
    for entry in entries:
        for values in itertools.product(*sweep.values()):
            swept = dict(zip(sweep, values, strict=True))
            texts = [f"{key}={json.dumps(value)}" for key, value in swept.items()]
            ends = [f"_{key.rpartition('.')[2]}={_plain(value)}" for key, value in swept.items()]
            yield replace(
                entry, name=entry.name + "".join(ends), set=(*entry.set, *texts), swept=swept
            )


def _plain(value: Any) -> str:
    """Return a value as part of the name of a folder."""
    return re.sub(r"[^A-Za-z0-9_.+-]", "-", str(value))


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
