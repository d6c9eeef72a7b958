"""`recon paper` on small scenes of our own in Middlebury's layout."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.commands.paper import run_paper
from recon.evaluation import paper
from recon.io.images.disparity import read_pfm
from recon.io.models.ply import read_ply
from recon.report import paper_page, style
from tests.flow.runs import summary_of
from tests.hostile import refusals
from tests.scenery.middlebury import CAMERA, write_scene
from tests.scenery.planes import slanted_pair, step_pair

Made = tuple[Path, dict[str, Any]]
PER_METHOD = ("disparity.pfm", "depth.pfm", "disparity_colour.png", "cloud.ply", "cloud_ascii.ply")


@pytest.fixture(scope="module", autouse=True)
def coarse_figures():
    """Draw few facets and few pixels: matplotlib takes most of the time of these tests for them."""
    draw = style.to_png
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper_page, "_SURFACE_COLUMNS", 30)
        patch.setattr(style, "to_png", lambda one, *seen: one.set_dpi(30) or draw(one, *seen))
        yield


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trainingQ")
    write_scene(folder / "ArtL", step_pair(CAMERA, 1.3, 2.0, 20.0, seed=1))
    write_scene(folder / "Jadeplant", slanted_pair(CAMERA, 1.6, (0.3, 0.0), seed=2))
    write_scene(folder / "Pipes", slanted_pair(CAMERA, 1.5, (0.0, -0.2), seed=3))
    return folder


@pytest.fixture(scope="module")
def run(scenes, tmp_path_factory):
    out = tmp_path_factory.mktemp("paper") / "run"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(paper, "PATCHES_PX", (3, 7, 11))
        done = refusals.run("paper", scenes, "--as-printed", "--json", "--out", out)
    assert done.code == 0, done.err
    return out, json.loads(done.out)


def test_every_product_is_there(run):
    out, _ = run
    expected = {"report.html", "summary.json", "run.json", "config.yaml"}
    for folder in ("experiment_2_ArtL", "experiment_3_Jadeplant", "experiment_4_Pipes"):
        expected.add(f"{folder}/clouds.mlp")
        for method in ("corrected", "absolute", "as_printed"):
            expected |= {f"{folder}/{method}/{name}" for name in PER_METHOD}
    assert {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()} == expected
    record = json.loads((out / "run.json").read_text())
    assert (set(record["files"]), record["inputs"]["files"]) == (expected, 15)
    folder = out / "experiment_2_ArtL" / "corrected"
    binary, text = read_ply(folder / "cloud.ply"), read_ply(folder / "cloud_ascii.ply")
    assert len(binary) > 1000
    assert np.allclose(binary.xyz, text.xyz, rtol=1e-5)  # text has fewer digits


def test_only_the_corrected_method_has_the_right_depth(run):
    out, summary = run
    for experiment in summary["experiments"].values():
        depth = {name: one["depth"] for name, one in experiment["methods"].items()}
        assert 0 < depth["corrected"]["median_error_percent"] < 1
        # 10 · (d + 10) / (180 · d): a tenth to a sixth of the true depth.
        assert 0.08 < depth["absolute"]["median_ratio"] < 0.17
        bad = {name: one["disparity"]["bad"]["1.0"] for name, one in experiment["methods"].items()}
        assert bad["corrected"] < 5
        assert bad["absolute"] < 15
        assert bad["as_printed"] > 60
        for figures in experiment["patches"].values():
            assert [one["patch_px"] for one in figures] == [3, 7, 11]
            for one in figures:
                assert 0 <= one["bad_percent"] + one["right_percent"] <= 100 + 1e-9
                assert 0 < one["valid_percent"] <= 100
    row = summary["table_1"][0]
    assert row["printed"] == {"focal_length": 10.0, "baseline_mm": 200.0, "ndisp": CAMERA.ndisp}
    assert row["corrected"]["focal_px"] == 180.0
    assert 83 < row["depth_error_of_printed_percent"] < 92
    # Printed depth is doffs times baseline over disparity, and 0 would be infinite.
    folder = out / "experiment_3_Jadeplant" / "absolute"
    disparity, depths = read_pfm(folder / "disparity.pfm"), read_pfm(folder / "depth.pfm")
    known = np.isfinite(depths)
    assert np.array_equal(known, np.nan_to_num(disparity) > 0)
    assert np.allclose(depths[known], 10 * 0.2 / disparity[known], rtol=1e-6)


def test_its_configuration_gives_the_same_figures(scenes, run, tmp_path, monkeypatch):
    printed = run[1]["experiments"]
    assert summary_of(run[0])["experiments"] == printed
    config = load_config(run[0] / "config.yaml")
    monkeypatch.setattr(paper, "PATCHES_PX", (3, 7, 11))
    again = run_paper(scenes, config, out=tmp_path / "again", threads=1).to_json()
    for number, one in again["experiments"].items():
        for kind in ("methods", "patches"):
            assert one[kind] == {"corrected": printed[number][kind]["corrected"]}


def test_a_scene_without_truth_is_reconstructed_and_told(scenes, tmp_path, monkeypatch):
    copy = Path(shutil.copytree(scenes, tmp_path / "scenes"))
    (copy / "ArtL" / "disp0GT.pfm").unlink()
    monkeypatch.setattr(paper, "PATCHES_PX", (5,))
    done = refusals.run("paper", copy, "--out", tmp_path / "out", "--json")
    assert done.code == 0, done.err
    summary = json.loads(done.out)
    assert summary["experiments"]["2"]["methods"]["corrected"]["disparity"] is None
    assert len(summary["warnings"]) == 1


@pytest.mark.parametrize(
    ("arguments", "named"), [((), "RECON_DATA"), (("scenes",), "Jadeplant, Pipes")]
)
def test_missing_scenes_are_reported_in_one_line(tmp_path, monkeypatch, arguments, named):
    monkeypatch.delenv("RECON_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes" / "ArtL").mkdir(parents=True)
    refusals.assert_refused(refusals.run("paper", *arguments, "--out", "out", "--json"), named)
    assert not (tmp_path / "out").exists()
