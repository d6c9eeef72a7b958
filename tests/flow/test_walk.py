"""The page that follows one pair names the files that a pair really goes through."""

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
from recon.core.progress import showing
from recon.core.values import StereoPair
from recon.map.store.map_file import MapFile
from recon.sources.images import ImageSource
from recon.sources.registry import open_source
from tests.scenery.film import Film
from tests.scenery.kitti import write_kitti

CODE = Path(recon.__file__).parent
MOST_FILES = 30
FOLLOWED = 5
"""The pair that is followed: features, submap and a keyframe are there by then."""


class Untold:
    """Who is told nothing: what is said of a pair is no part of its walk."""

    def on_start(self, *_: object) -> None:
        return

    on_step = on_stage = on_finish = on_start


def walked(street_film: Film, folder: Path) -> set[str]:
    entered, on, looked = set(), False, False
    write_kitti(street_film, folder / "drive")
    read, commit = ImageSource.frames, MapFile.commit

    def trace(frame: FrameType, event: str, _: Any) -> None:
        if on and event == "call" and frame.f_code.co_name != "<module>":
            entered.add(frame.f_code.co_filename)

    def frames(self: ImageSource, start: int = 0) -> Iterator[StereoPair]:
        nonlocal on
        pairs = read(self, start)
        for index in range(len(self)):
            on |= looked and index == FOLLOWED
            yield next(pairs)

    def begun(folder: Path) -> None:
        nonlocal looked
        looked = True

    def committed(self: MapFile) -> None:
        nonlocal on
        commit(self)
        on = False

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ImageSource, "frames", frames)
        patch.setattr(MapFile, "commit", committed)
        threading.setprofile(trace)
        sys.setprofile(trace)
        try:
            config = load_config(None, ["checkpoints.every_frames=8"])
            options = MapOptions(out=folder / "out", audit=False, mesh=False, begun=begun)
            with showing(Untold()):
                run_map(open_source(folder / "drive"), config, options)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    paths = (path for path in map(Path, entered) if path.is_relative_to(CODE))
    files = [path.relative_to(CODE.parent) for path in paths]
    # Kernels, values and settings are what the others use.
    beside = {"kernels", "values", "settings.py", "__init__.py"}
    return {path.as_posix() for path in files if not beside & {*path.parts}}


def test_the_page_names_the_files_that_a_pair_enters(street_film, tmp_path):
    files = walked(street_film, tmp_path)
    page = (CODE.parent / "docs" / "architecture.md").read_text()
    section = page.partition("## The walk of one pair")[2].partition("\n## ")[0]
    steps = section.partition("### From its reading to its commit")[2].partition("\n### ")[0]
    assert set(re.findall(r"`(recon/[\w/]+\.py)`", steps)) == files
    assert 15 < len(files) <= MOST_FILES
