"""Clouds of which nothing can be made: the error names their file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from recon.core.values import PointCloud
from recon.core.values.arrays import Float32
from recon.io.models.ply import read_ply, write_ply
from tests.hostile.refusals import assert_refused, refusal, run

pytestmark = pytest.mark.timeout(120)


def _ball(count: int = 300) -> Float32:
    return np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)


def _with_a_far_point() -> Float32:
    points = _ball()
    points[0] = 1e30
    return points


CLOUDS: Final[dict[str, Callable[[], Float32]]] = {
    "few points": lambda: _ball(10),
    "one line": lambda: np.outer(np.arange(300), [1, 2, 3]).astype(np.float32),
    "one place": lambda: np.ones((300, 3), np.float32),
    "a far point": _with_a_far_point,
    "all points far apart": lambda: _ball() * np.float32(1e20),
    "no point": lambda: _ball(0),
}
APART: Final = ("a far point", "all points far apart", "no point")


@pytest.mark.parametrize("spoiled", CLOUDS)
def test_a_cloud_without_a_surface_is_named(spoiled: str, here: Path) -> None:
    write_ply("spoiled.ply", PointCloud(CLOUDS[spoiled]()))
    assert_refused(run("mesh", "spoiled.ply", "--out", "out", "--quiet"), "spoiled.ply: ")
    assert not Path("out").exists()


@pytest.mark.parametrize("spoiled", APART)
@pytest.mark.parametrize("names", [("good.ply", "spoiled.ply"), ("spoiled.ply", "good.ply")])
def test_a_cloud_that_cannot_be_compared_is_named(
    spoiled: str, names: tuple[str, str], here: Path
) -> None:
    write_ply("spoiled.ply", PointCloud(CLOUDS[spoiled]()))
    write_ply("good.ply", PointCloud(_ball()))
    assert_refused(run("evaluate", "map", *names), "spoiled.ply")


def test_rows_without_a_column_are_not_read_for_ever(here: Path) -> None:
    element = "element nothing 1000000000000\n"
    Path("a.ply").write_text(
        f"ply\nformat ascii 1.0\n{element}element vertex 1\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    line = refusal(lambda: read_ply("a.ply"))
    assert line is not None
    assert line.startswith("a.ply: the file is truncated")
