"""Which times the pairs of plain folders get."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import FormatError, SourceError
from recon.core.values import RectifiedCamera
from recon.io.images.image import write_image
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from tests.sources import drives

CAMERA = RectifiedCamera(60.0, 31.5, 15.5, 31.5, 0.5, 64, 32)


def write_named(folder: Path, names: list[str]) -> Path:
    """Pairs of equal names in two folders, the grey values counting the frames."""
    for number, name in enumerate(names):
        for side in ("left", "right"):
            write_image(folder / side / f"{name}.png", np.full((32, 64), number, np.uint8))
    drives.write_calib(folder, CAMERA)
    return folder


def times(folder: Path, **settings: object) -> list[float]:
    source = open_source(folder, "folders", SourceSettings.model_validate(settings))
    return source.stamps_s.tolist()


@pytest.mark.parametrize("digits", [10, 13, 16, 19])
@pytest.mark.parametrize("step", [1, 5])
def test_padded_counters_are_no_times(tmp_path: Path, digits: int, step: int) -> None:
    folder = write_named(tmp_path, [f"{100 + step * k:0{digits}d}" for k in range(4)])
    assert times(folder) == [0.0, 0.1, 0.2, 0.3]
    assert "no times: assumed 10 Hz" in open_source(folder).description


def test_a_single_padded_counter_is_no_time(tmp_path: Path) -> None:
    assert times(write_named(tmp_path, ["0000000123"])) == [0.0]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["1600000000", "1600000001"], [1600000000, 1600000001]),
        (["1600000000123", "1600000000156"], [1600000000.123, 1600000000.156]),
        # Nanoseconds since a simulation began.
        (["0000000000000000000", "0000000000050000000"], [0.0, 0.05]),
    ],
)
def test_integer_times_stay_times(tmp_path: Path, names: list[str], expected: list[float]) -> None:
    assert times(write_named(tmp_path, names)) == pytest.approx(expected, abs=1e-6)


def test_a_times_file_may_have_numbers_and_exposures(tmp_path: Path) -> None:
    folder = write_named(tmp_path, [f"{k:05d}" for k in range(4)])
    rows = [f"{k:05d} {7 + 0.25 * k:.6f} 1.5e-3\n" for k in range(4)]
    (folder / "times.txt").write_text("".join(rows))
    assert times(folder) == [7.0, 7.25, 7.5, 7.75]
    (folder / "times.txt").write_text("".join([*rows[:2], rows[1], rows[3]]))
    with pytest.raises(SourceError, match=r"times\.txt:3: two images have the same timestamp"):
        times(folder)
    (folder / "times.txt").write_text("1 2\n3 4\n")
    with pytest.raises(FormatError, match="got 2, expected 1 or 3"):
        times(folder)


@pytest.mark.parametrize("name", ["{:010d}", "16000000{:02d}", "{}.5", "frame{}"])
@pytest.mark.parametrize("place", [".", "left"])
def test_a_times_file_wins_over_names(tmp_path: Path, name: str, place: str) -> None:
    folder = write_named(tmp_path, [name.format(k) for k in range(4)])
    (folder / place / "times.txt").write_text("7.0\n7.25\n7.5\n7.75\n")
    assert times(folder) == [7.0, 7.25, 7.5, 7.75]
    assert folder / place / "times.txt" in open_source(folder).files
    assert times(folder, rate_hz=5.0) == pytest.approx([0, 0.2, 0.4, 0.6])
