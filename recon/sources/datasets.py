"""Public data sets that can be mapped: where they come from and how they are laid out.

The list is ``datasets.toml`` beside this file; its first lines explain it.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

from pydantic import Field

from recon.core.errors import SettingsError
from recon.core.settings import Settings
from recon.io.toml_file import read_toml

_LIST: Final = Path(__file__).with_suffix(".toml")


class Facts(Settings):
    """What is known of a file beforehand; the digest begins with its kind, such as ``md5:``."""

    bytes: int | None = None
    digest: str | None = None
    id: str = ""


class Archive(Facts):
    """One archive of a data set: its address, its name here, and what of it is unpacked."""

    path: str
    file: str = ""
    below: str = ""
    without: tuple[str, ...] = ()
    zips: bool = False

    def of_part(self, part: str, base: str, files: dict[str, Facts]) -> Archive:
        """Return the archive of one part, with its whole address and what is known of it."""
        file = (self.file or self.path.rpartition("/")[2]).format(part=part)
        facts = files.get(file, Facts())
        path = base + self.path.format(part=part, id=facts.id)
        below = self.below.format(part=part)
        return self.model_copy(update={**dict(facts), "path": path, "file": file, "below": below})


class Dataset(Settings):
    """One entry of the list; ``digest_beside`` is the kind of the hash beside each archive."""

    name: str
    about: str
    page: str
    licence: str
    cite: str
    layout: str
    use: str
    unchecked: str = ""
    digest_beside: str = ""
    base: str
    parts: tuple[str, ...] = ("",)
    archives: tuple[Archive, ...]
    files: dict[str, Facts] = Field(default_factory=dict)


@dataclass(frozen=True)
class Part:
    """What is fetched at once, into one folder: ``kitti-raw/2011_09_26_drive_0013``."""

    dataset: Dataset
    name: str
    archives: tuple[Archive, ...]

    @property
    def size(self) -> int | None:
        """Bytes to download; None = not known beforehand."""
        sizes = [one.bytes for one in self.archives]
        return None if None in sizes else sum(size or 0 for size in sizes)


@cache
def datasets() -> dict[str, Dataset]:
    """Return the list, by name."""
    entries = [Dataset.parse(one, where=str(_LIST)) for one in read_toml(_LIST)["dataset"]]
    return {one.name: one for one in entries}


def parts_of(dataset: Dataset) -> list[Part]:
    """Return the parts of a data set, in the order of the list; at least one."""
    return [
        Part(
            dataset,
            f"{dataset.name}/{part}".rstrip("/"),
            tuple(one.of_part(part, dataset.base, dataset.files) for one in dataset.archives),
        )
        for part in dataset.parts
    ]


def find_parts(name: str) -> list[Part]:
    """Return the parts that a name means: those of a data set, or one."""
    whole = name.rstrip("/").partition("/")[0]
    every = [part for one in datasets().values() for part in parts_of(one)]
    parts = [part for part in every if part.dataset.name == whole]
    found = [part for part in parts if name.rstrip("/") in (whole, part.name)]
    if not found:
        names = [part.name for part in parts] or list(datasets())
        near = difflib.get_close_matches(name, names, n=3) or ([] if parts else names)
        hint = f"`recon datasets list{' ' + whole if parts else ''}` lists them"
        expected = ", ".join(near) or None
        raise SettingsError("unknown data set or part", got=name, expected=expected, hint=hint)
    return found
