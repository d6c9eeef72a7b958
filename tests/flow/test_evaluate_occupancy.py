"""`recon evaluate occupancy`: the files of a run give the same figures as the run itself."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.commands.evaluate import run_evaluate_occupancy
from recon.core.errors import EvaluationError, FormatError
from recon.io.models.nav2 import read_nav2
from recon.report.style import GRID_ERRORS, GRID_NOT_COUNTED
from recon.run.run import plain
from tests.hostile import refusals


@pytest.fixture
def run(small_demo: Path) -> Path:
    return small_demo


def test_the_files_of_a_run_give_its_own_figures(run: Path) -> None:
    told = json.loads((run / "summary.json").read_text())["occupancy"]
    assert plain(run_evaluate_occupancy(run).metrics) == told
    assert 0 < told["voxels"]["precision"] < 1


def test_more_frames_must_have_seen_what_is_compared(run: Path) -> None:
    few, many = (run_evaluate_occupancy(run, least).metrics for least in (1, 6))
    assert few.voxels.true_voxels > many.voxels.true_voxels > 0
    assert many.least_frames == 6


def test_the_command_prints_json_and_draws_what_is_wrong(run: Path, tmp_path: Path) -> None:
    image = tmp_path / "compared.png"
    done = refusals.run("evaluate", "occupancy", run, "--json", "--picture", image)
    assert done.code == 0, done.err
    printed = json.loads(done.out)
    assert printed.pop("warnings") == []
    assert printed == json.loads((run / "summary.json").read_text())["occupancy"]

    colours = cv2.imread(str(image))[..., ::-1].reshape(-1, 3)
    counts = {kind: int((colours == rgb).all(axis=1).sum()) for kind, rgb in GRID_ERRORS.items()}
    # A cell is a square of pixels.
    side_px = math.isqrt(sum(counts.values()) // printed["grid"]["cells"])
    counts = {kind: pixels / side_px**2 for kind, pixels in counts.items()}
    assert sum(counts.values()) == printed["grid"]["cells"]
    true = sum(n for (kind, _), n in counts.items() if kind == 100)
    assert true == printed["grid"]["true_occupied"]
    unknown = sum(n for (_, kind), n in counts.items() if kind == -1)
    assert unknown / printed["grid"]["cells"] == pytest.approx(printed["grid"]["unknown"])
    assert (colours == GRID_NOT_COUNTED).all(axis=1).any()


def test_a_run_whose_truth_is_not_known_is_refused(run: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(run, tmp_path / "drive")
    record = json.loads((copy / "run.json").read_text())
    (copy / "run.json").write_text(json.dumps({**record, "command": "map"}))
    with pytest.raises(EvaluationError, match=r"not known.*recon map.*evaluate map"):
        run_evaluate_occupancy(copy)


@pytest.mark.parametrize(
    ("lost", "words"),
    [
        ("run.json", "not contain a finished run"),
        ("map/octomap.ot", "octomap.ot: file does not exist"),
        ("map/grid.yaml", "grid.yaml: file does not exist"),
        ("map/grid.pgm", "grid.pgm: file does not exist"),
    ],
)
def test_a_folder_without_its_files_is_refused(
    run: Path, tmp_path: Path, lost: str, words: str
) -> None:
    copy = shutil.copytree(run, tmp_path / "copy")
    (copy / lost).unlink()
    with pytest.raises(FormatError, match=words):
        run_evaluate_occupancy(copy)


@pytest.mark.parametrize("record", ["{}", "no json", "[]", '{"T_map_world": [[1], 2]}'])
def test_a_broken_record_is_refused(run: Path, tmp_path: Path, record: str) -> None:
    copy = shutil.copytree(run, tmp_path / "copy")
    (copy / "run.json").write_text(record)
    with pytest.raises(FormatError, match="record"):
        run_evaluate_occupancy(copy)


def test_grids_that_other_programs_drew_larger_are_compared_all_the_same(
    run: Path, tmp_path: Path
) -> None:
    copy = shutil.copytree(run, tmp_path / "copy")
    grid = read_nav2(copy / "map" / "grid.yaml")
    rows, columns = grid.cells.shape
    image = np.full((rows + 7, columns + 5), 205, np.uint8)
    original = cv2.imread(str(copy / "map" / "grid.pgm"), cv2.IMREAD_GRAYSCALE)
    image[7:, 5:] = original  # row 0 is the top: the origin moves left, and not down
    cv2.imwrite(str(copy / "map" / "grid.pgm"), image)
    text = (copy / "map" / "grid.yaml").read_text()
    x = grid.origin_m[0]
    assert f"- {x}" in text
    (copy / "map" / "grid.yaml").write_text(text.replace(f"- {x}", f"- {x - 5 * 0.2}", 1))
    assert run_evaluate_occupancy(copy).metrics == run_evaluate_occupancy(run).metrics
