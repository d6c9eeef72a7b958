"""From what is asked for to jobs: every command line is checked before anything runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from recon.core.errors import FormatError, SettingsError
from recon.io.atomic import write_text
from recon.io.files import read_text, reading
from recon.io.middlebury.layout import find_image, find_layout
from recon.run.batch.job import Job
from recon.run.batch.job_file import Entry, check_names
from recon.run.memory import parse_size_mb

PLAN: Final = "jobs.json"
"""The jobs of a batch, in its folder from the first moment."""
_PLAN_BYTES: Final = 1 << 30
#: A job writes into its own folder alone, and says what the batch reads.
_NOT_OPTIONS: Final = (
    "--out", "-o", "--resume", "--json", "--latex", "--quiet", "-q", "--help", "--", "--into",
    "--remove", "--mend", "--picture",
)  # fmt: skip
_WITHOUT_SOURCE: Final = ("demo",)


@dataclass(frozen=True)
class Program:
    """What jobs can run.

    Attributes:
        commands: The options of each command, by its name.
        check: Raises `SettingsError` if the words after ``recon`` are no command line.
    """

    commands: Mapping[str, frozenset[str]]
    check: Callable[[Sequence[str]], None]


@dataclass(frozen=True)
class Limits:
    """What holds for jobs that do not say otherwise.

    Attributes:
        threads: Threads of a job; None = as many as its command takes.
        memory: Memory limit of a job of a command that has one, such as ``4G``; None = none.
        timeout_s: Longest time of one try; None = any.
        retries: Tries after the first that broke.
    """

    threads: int | None = None
    memory: str | None = None
    timeout_s: float | None = None
    retries: int = 2


def plan_jobs(
    entries: Sequence[Entry], program: Program, limits: Limits, folder: Path
) -> list[Job]:
    """Turn what is asked for into jobs.

    Args:
        entries: What is asked for.
        program: What jobs can run.
        limits: What holds where an entry does not say otherwise.
        folder: Where relative paths begin.

    Raises:
        SettingsError: A command or an option is unknown, or would write elsewhere.
    """
    return [_job(entry, program, limits, folder.resolve()) for entry in entries]


def write_plan(jobs: Sequence[Job], folder: Path) -> None:
    """Write the jobs into the folder of their batch.

    Raises:
        OutputError: The folder cannot be written.
    """
    write_text(folder / PLAN, json.dumps([job.plain() for job in jobs], indent=1))


def read_plan(folder: Path) -> list[Job]:
    """Read the jobs of a batch.

    Raises:
        FormatError: The folder is not one of a batch, or its jobs cannot be read.
        SettingsError: A job would write outside of the folder.
    """
    path = folder / PLAN
    if not path.is_file():
        raise FormatError("folder holds no batch", where=folder, expected=f"a {PLAN}")
    with reading(path):
        listed = json.loads(read_text(path, _PLAN_BYTES))
        jobs = [Job(**{**job, "words": tuple(job["words"])}) for job in listed]
        # A batch from elsewhere must not write elsewhere.
        check_names([Entry(job.name, job.command) for job in jobs], str(path))
        for job in jobs:
            _options(job.words, f"{path}: job {job.name}")
    return jobs


def _job(entry: Entry, program: Program, limits: Limits, folder: Path) -> Job:
    where, command = f"job {entry.name}", " ".join(entry.command.split())
    if command not in program.commands:
        known = ", ".join(program.commands)
        raise SettingsError("unknown command", where=where, got=entry.command, expected=known)
    if not entry.source and command not in _WITHOUT_SOURCE:
        raise SettingsError("job has no source", where=where)
    takes, entry = program.commands[command], _fill_in(entry, limits)
    words = [*command.split(), *_sources(command, entry.source, folder)]
    words += [word for text in entry.set for word in ("--set", text)]
    words += _given(takes, "--threads", entry.threads) + _given(
        takes, "--memory-limit", entry.memory
    )
    for word in entry.options:
        if word.partition("=")[0] == "--set" or word[:2] == "-s":
            hint = "settings have a place of their own: the key set of a job, or recon batch --set"
            raise SettingsError("a setting among the options", where=where, got=word, hint=hint)
    words += _options(entry.options, where)
    try:
        program.check(words)
    except SettingsError as error:
        raise SettingsError(error.what, where=where, got=error.got) from error
    needs = {
        **({} if entry.threads is None else {"threads": float(entry.threads)}),
        **({} if entry.memory is None else {"memory": 1e6 * parse_size_mb(entry.memory)}),
    }
    return Job(
        name=entry.name,
        command=command,
        source=" ".join(entry.source),
        words=tuple(words),
        writes="--out" in takes,
        folder=str(folder),
        timeout_s=entry.timeout_s,
        retries=limits.retries if entry.retries is None else entry.retries,
        needs=needs,
        swept=entry.swept,
    )


def _fill_in(entry: Entry, limits: Limits) -> Entry:
    """Give an entry the limits that it does not have."""
    return replace(
        entry,
        threads=entry.threads or limits.threads,
        memory=entry.memory or limits.memory,
        timeout_s=entry.timeout_s or limits.timeout_s,
    )


def _given(takes: frozenset[str], option: str, value: object) -> list[str]:
    return [option, str(value)] if value is not None and option in takes else []


def _options(options: Sequence[str], where: str) -> Sequence[str]:
    for word in options:
        if word.partition("=")[0] in _NOT_OPTIONS or word[:2] in ("-o", "-q"):
            raise SettingsError("a job cannot have this option", where=where, got=word)
    return options


def _sources(command: str, source: Sequence[str], folder: Path) -> list[str]:
    """Return the arguments of a command; for a pair, the files of a scene's folder."""
    if command not in ("pair", "disparity") or len(source) != 1:
        return list(source)
    place = folder / source[0]
    layout = find_layout(place) if place.is_dir() else None
    if layout is None:  # the job itself says what is missing
        return [str(place / "im0.png"), str(place / "im1.png")]
    images = (find_image(place, stem) or place / stem for stem in (layout.left, layout.right))
    calib, truth = place / "calib.txt", place / f"{layout.truth_left}.pfm"
    return [
        *map(str, images),
        *(["--calib", str(calib)] if calib.is_file() else []),
        *(["--truth", str(truth)] if truth.is_file() and command == "pair" else []),
    ]
