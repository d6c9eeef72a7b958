"""The page that follows one pair names the files that a pair really goes through."""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

import recon
from recon.commands.config import load_config
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.values import StereoPair
from recon.map.store.map_file import MapFile
from recon.sources.images import ImageSource
from recon.sources.registry import open_source
from tests.scenery.film import Film
from tests.scenery.kitti import write_kitti

CODE = Path(recon.__file__).parent
MOST_FILES = 25
FOLLOWED = 5
"""The pair that is followed: features, submap and a keyframe are there by then."""


def is_walked(path: Path) -> bool:
    """Whether a file counts: kernels, values and settings are what the others use."""
    beside = {"kernels", "values"} & set(path.parts)
    return not beside and path.name not in {"settings.py", "__init__.py"}


class Tracer:
    """Notes the files of recon whose functions are called in any thread while it is on."""

    def __init__(self) -> None:
        self.on = False
        self.files: set[Path] = set()

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        if self.on and event == "call" and frame.f_code.co_name != "<module>":
            path = Path(frame.f_code.co_filename)
            if path.is_relative_to(CODE):
                self.files.add(path.relative_to(CODE.parent))


def walked(street_film: Film, folder: Path) -> set[str]:
    """Files entered from the reading of one pair to the commit after it."""
    tracer = Tracer()
    write_kitti(street_film, folder / "drive")
    read, commit = ImageSource.frames, MapFile.commit

    def frames(self: ImageSource, start: int = 0) -> Iterator[StereoPair]:
        pairs = read(self, start)
        for index in range(len(self)):
            tracer.on |= index == FOLLOWED
            yield next(pairs)

    def committed(self: MapFile) -> None:
        commit(self)
        tracer.on = False

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ImageSource, "frames", frames)
        patch.setattr(MapFile, "commit", committed)
        threading.setprofile(tracer)
        sys.setprofile(tracer)
        try:
            config = load_config(None, ["checkpoints.every_frames=8"])
            options = MapOptions(out=folder / "out", audit=False, mesh=False)
            run_map(open_source(folder / "drive"), config, options)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    return {path.as_posix() for path in tracer.files if is_walked(path)}


def named() -> set[str]:
    """Files that the page names on the way."""
    page = (CODE.parent / "docs" / "architecture.md").read_text()
    section = page.partition("## The walk of one pair")[2].partition("\n## ")[0]
    steps = section.partition("### From its reading to its commit")[2].partition("\n### ")[0]
    return set(re.findall(r"`(recon/[\w/]+\.py)`", steps))


def test_the_page_names_the_few_files_that_a_pair_goes_through(
    street_film: Film, tmp_path: Path
) -> None:
    files = walked(street_film, tmp_path)
    assert named() == files
    assert 15 < len(files) <= MOST_FILES
