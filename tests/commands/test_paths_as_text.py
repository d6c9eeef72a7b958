"""The public functions take paths as text, too, as those of Python do."""

from __future__ import annotations

from pathlib import Path

import pytest

import recon
from recon.core.errors import FormatError
from recon.run.run import Run


def test_a_map_is_made_and_opened_by_its_name(tmp_path: Path) -> None:
    with recon.Map.create(f"{tmp_path}/map/map.recon") as map_:
        map_.commit()
    for name in (f"{tmp_path}/map/map.recon", str(tmp_path)):
        with recon.Map.open(name) as map_:
            assert map_.sessions == []


def test_settings_are_read_by_the_name_of_their_file(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("grid: {max_height_m: 3}")
    assert recon.load_config(f"{tmp_path}/robot.yaml").grid.max_height_m == 3


def test_a_run_writes_to_a_folder_by_its_name(tmp_path: Path) -> None:
    with Run("pair", f"{tmp_path}/out") as run:
        run.path("a.txt").write_text("a")
    assert (tmp_path / "out/a.txt").is_file()


def test_a_folder_that_is_no_run_is_named_whatever_the_type(tmp_path: Path) -> None:
    for make in (recon.run_export, recon.run_occupancy):
        for folder in (tmp_path, str(tmp_path)):
            with pytest.raises(FormatError, match="does not contain a finished run"):
                make(folder)
    source = recon.SyntheticSource()
    with pytest.raises(FormatError, match=r"folder has no map \(expected a map/map\.recon"):
        recon.run_localize(source, str(tmp_path), options=recon.MapOptions(out=f"{tmp_path}/out"))
