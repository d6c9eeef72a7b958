"""Public data sets that can be mapped: where they come from and how they are laid out.

The list is ``datasets.toml`` beside this file; its first lines explain it.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

from pydantic import Field

from recon.core.errors import SettingsError
from recon.core.settings import Settings
from recon.io.archives import Choice
from recon.io.download import Promise
from recon.io.toml_file import read_toml

_LIST: Final = Path(__file__).with_suffix(".toml")


class _Facts(Settings):
    bytes: int | None = None
    digest: str | None = None
    id: str = ""


class _Archive(Settings):
    path: str
    file: str = ""
    below: str = ""
    without: tuple[str, ...] = ()
    zips: bool = False


class Dataset(Settings):
    """One entry of the list.

    Attributes:
        name: Its name, and that of its folder.
        about: What it shows.
        page: Where its owners describe it.
        licence: Its terms.
        cite: What to cite.
        layout: Its files, below the folder that `recon datasets fetch` writes.
        use: A command that reads it.
        unchecked: Why there is no hash to compare with; "" = there is one.
        digest_beside: Kind of the hash that is in a file beside each archive; "" = there is none.
        parts: What can be fetched by itself; none = only the whole.
    """

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
    parts: tuple[str, ...] = ()
    archives: tuple[_Archive, ...]
    files: dict[str, _Facts] = Field(default_factory=dict)


@dataclass(frozen=True)
class Download:
    """One archive of a part.

    Attributes:
        address: Where its owners offer it.
        file: Name of the file, here and on a mirror.
        promise: What is known of it beforehand.
        choice: What of it is unpacked.
        digest_beside: Suffix and kind of a file with its hash; "" = there is none.
    """

    address: str
    file: str
    promise: Promise
    choice: Choice
    digest_beside: str = ""


@dataclass(frozen=True)
class Part:
    """What is fetched at once, into one folder.

    Attributes:
        dataset: The data set.
        name: Its name, such as ``kitti-raw/2011_09_26_drive_0013``.
        downloads: Its archives, in the order in which they are unpacked.
    """

    dataset: Dataset
    name: str
    downloads: tuple[Download, ...]

    @property
    def size(self) -> int | None:
        """Bytes to download; None = not known beforehand."""
        sizes = [one.promise.size for one in self.downloads]
        return None if None in sizes else sum(size or 0 for size in sizes)


@cache
def datasets() -> dict[str, Dataset]:
    """Return the list, by name."""
    entries = [Dataset.parse(one, where=str(_LIST)) for one in read_toml(_LIST)["dataset"]]
    return {one.name: one for one in entries}


def parts_of(dataset: Dataset) -> Iterator[Part]:
    """Yield the parts of a data set, in the order of the list; at least one."""
    for part in dataset.parts or ("",):
        name = f"{dataset.name}/{part}" if part else dataset.name
        yield Part(dataset, name, tuple(_download(dataset, one, part) for one in dataset.archives))


def find_parts(name: str) -> list[Part]:
    """Return the parts that a name means: those of a data set, or one.

    Raises:
        SettingsError: There is no such data set or part.
    """
    whole = name.rstrip("/").partition("/")[0]
    known = list(datasets()) if whole not in datasets() else []
    parts = [] if known else list(parts_of(datasets()[whole]))
    found = [part for part in parts if name.rstrip("/") in (whole, part.name)]
    if found:
        return found
    near = difflib.get_close_matches(name, known or [part.name for part in parts], n=3)
    raise SettingsError(
        "unknown data set" if known else f"{whole} has no such part",
        got=name,
        expected=", ".join(near or known) or None,
        hint=f"`recon datasets list{'' if known else ' ' + whole}` lists them",
    )


def _download(dataset: Dataset, archive: _Archive, part: str) -> Download:
    name = (archive.file or archive.path.rpartition("/")[2]).format(part=part)
    facts = dataset.files.get(name, _Facts())
    choice = Choice(archive.below.format(part=part), archive.without, archive.zips)
    return Download(
        dataset.base + archive.path.format(part=part, id=facts.id),
        name,
        Promise(facts.bytes, facts.digest),
        choice,
        dataset.digest_beside,
    )
