"""From what a batch is asked for to jobs: command lines of this program, all checked."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import typer

from recon.core.errors import SettingsError
from recon.core.machine import parse_size_mb
from recon.io.files import naming
from recon.io.middlebury import find_image, find_layout
from recon.run.batch.job import Job
from recon.run.batch.job_file import Entry, JobList, check_names, name_of_swept

COMMANDS: Final = (
    "map", "localize", "merge", "diff", "pair", "disparity", "export", "mesh", "occupancy",
    "rectify", "audit", "demo", "paper", "evaluate trajectory", "evaluate map",
    "evaluate occupancy", "evaluate disparity", "evaluate middlebury",
)  # fmt: skip
"""What a job can be."""
_WITHOUT_SOURCE: Final = ("demo",)
_NOT_OPTIONS: Final = frozenset(
    ("--out", "--resume", "--json", "--latex", "--quiet", "--into", "--remove", "--repair",
     "--picture", "--check")
)  # fmt: skip
"""A job writes into its own folder alone, and says what the batch reads."""
# Typer has a copy of click in it, or uses the one that is installed.
_USAGE_ERROR: Any = typer.BadParameter.__base__


def plan_jobs(listed: JobList) -> list[Job]:
    """Turn what is asked for into jobs; of a sweep, each value is checked once."""
    sets = {tuple(entry.set): entry.name for entry in reversed(listed.job)}
    for texts, name in sets.items():
        _check_settings(texts, name, listed)
    folder = Path(listed.folder)
    plain = [_job(entry, folder, sets=bool(entry.set or listed.sweep)) for entry in listed.job]
    jobs = [job for one in plain for job in _swept(one, listed)]
    check_names(job.name for job in jobs)
    return jobs


def _swept(job: Job, listed: JobList) -> Iterator[Job]:
    for swept in listed.combinations():
        words = [word for text in _texts(swept) for word in ("--set", text)]
        name = name_of_swept(job.name, swept)
        yield replace(job, name=name, words=(*job.words, *words), swept=swept)


def _check_settings(texts: Sequence[str], name: str, listed: JobList) -> None:
    """Refuse settings that there are not: each value of a sweep, beside the first of others."""
    from recon.commands.config import load_config

    first = {key: values[0] for key, values in listed.sweep.items()}
    others = ({**first, key: value} for key, values in listed.sweep.items() for value in values[1:])
    for swept in (first, *others):
        with naming(f"job {name}"):
            load_config(None, [*texts, *_texts(swept)])


def _job(entry: Entry, folder: Path, *, sets: bool) -> Job:
    where, command = f"job {entry.name}", " ".join(entry.command.split())
    if command not in COMMANDS:
        known = ", ".join(COMMANDS)
        raise SettingsError("unknown command", where=where, got=entry.command, expected=known)
    if not entry.source and command not in _WITHOUT_SOURCE:
        raise SettingsError("job has no source", where=where)
    takes = {option for one in _command(command).params for option in one.opts}
    if sets and "--set" not in takes:
        raise SettingsError("command has no settings", where=where, got=command)
    with naming(where):
        sources, found = _sources(command, entry.source, folder)
        _check(command, len(sources), tuple(entry.options))
        memory = None if entry.memory is None else 1e6 * parse_size_mb(entry.memory)
    words = [*command.split(), *sources, *found]
    words += [word for text in entry.set for word in ("--set", text)]
    limits = {"--threads": entry.threads, "--memory-limit": entry.memory}
    for option, value in limits.items():
        words += [option, str(value)] if value is not None and option in takes else []
    shown = [option for option in ("--json", "--verbose") if option in takes]
    needs = {"threads": entry.threads, "memory": memory}
    return Job(
        name=entry.name,
        command=command,
        source=" ".join(entry.source),
        words=(*words, *entry.options, *shown),
        writes="--out" in takes,
        folder=str(folder),
        timeout_s=entry.timeout_s,
        retries=Job.retries if entry.retries is None else entry.retries,
        needs={name: float(least) for name, least in needs.items() if least is not None},
    )


@cache
def _command(name: str) -> Any:
    from recon.cli import app

    command: Any = typer.main.get_command(app)
    for word in name.split():
        command = command.commands[word]
    return command


@cache
def _check(name: str, sources: int, options: tuple[str, ...]) -> None:
    if wrong := {"--", "--help"} & {*options}:
        raise SettingsError("a job cannot have this option", got=wrong.pop())
    command, words = _command(name), [*["SOURCE"] * sources, *options]
    try:
        context = command.make_context(f"recon {name}", words)
    except _USAGE_ERROR as error:
        raise SettingsError(error.format_message(), got=" ".join([name, *options])) from error
    for option in command.params:
        if context.get_parameter_source(option.name).name != "COMMANDLINE":
            continue
        if "--set" in option.opts:
            hint = "settings have a place of their own: the key set of a job, or recon batch --set"
            raise SettingsError("a setting among the options", hint=hint)
        if _NOT_OPTIONS & {*option.opts}:
            raise SettingsError("a job cannot have this option", got=option.opts[0])


def _texts(swept: Mapping[str, Any]) -> list[str]:
    return [f"{key}={json.dumps(value)}" for key, value in swept.items()]


def _sources(
    command: str, source: Sequence[str], folder: Path
) -> tuple[Sequence[str], Sequence[str]]:
    """Return the arguments of a command and options that come of them: of a scene, its files."""
    for word in source:
        if word.startswith("-"):
            raise SettingsError("source is an option", got=word, hint=f"a file: ./{word}")
    if command not in ("pair", "disparity") or len(source) != 1:
        return source, ()
    place = folder / source[0]
    layout = find_layout(place) if place.is_dir() else None
    if layout is None:  # the job itself says what is missing
        return [str(place / "im0.png"), str(place / "im1.png")], ()
    images = [find_image(place, stem) or place / stem for stem in (layout.left, layout.right)]
    known = {"--calib": place / "calib.txt", "--truth": place / f"{layout.truth_left}.pfm"}
    if command != "pair":
        del known["--truth"]
    found = [word for key, file in known.items() if file.is_file() for word in (key, str(file))]
    return [*map(str, images)], found
