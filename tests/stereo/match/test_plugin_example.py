"""The matcher of docs/walk-research.md, as an object and as an installed plug-in."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import recon
from tests.stereo.match.plugins import install_plugin

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PAGE = Path(__file__).parents[3] / "docs" / "walk-research.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE)


def test_the_example_finds_a_shift_when_it_is_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (source,) = [block for block in blocks("python") if "class BlockMatcher" in block]
    (project,) = [tomllib.loads(block) for block in blocks("toml")]
    points = project["project"]["entry-points"]["recon.matchers"]
    install_plugin(tmp_path, project["project"]["name"], {"block_matcher.py": source}, points)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "block_matcher", raising=False)

    noise = np.random.default_rng(8).integers(0, 256, (40, 130), dtype=np.uint8)
    world = cv2.GaussianBlur(noise, (3, 3), 0)
    found = recon.match(world[:, :120], world[:, 6:126], matcher="block")
    # Beyond the left rim, where the shift is visible, it is found everywhere but beside the rims.
    inner = found.values[5:-5, 12:-5]
    assert np.mean(inner == 6) > 0.99


def test_the_page_says_what_the_arrays_give() -> None:
    truth = np.full((20, 30), 7.0)
    assert recon.evaluate_disparity(truth + 0.75, truth).bad == {0.5: 100, 1: 0, 2: 0, 4: 0}
