"""`recon paper` on small scenes of our own in Middlebury's layout."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from recon.commands.config import load_config
from recon.commands.paper import headline, run_paper
from recon.core.values import RectifiedCamera
from recon.io.images.disparity import read_pfm, write_pfm
from recon.io.images.image import write_image
from recon.io.models.ply import read_ply
from recon.report import paper_page
from tests.hostile import refusals
from tests.scenery.planes import PlanePair, slanted_pair, step_pair

WIDTH_PX, HEIGHT_PX, NDISP = 120, 80, 24
PER_METHOD = {"disparity.pfm", "depth.pfm", "disparity_colour.png", "cloud.ply", "cloud_ascii.ply"}
CALIB = """cam0=[{f} 0 {cx}; 0 {f} {cy}; 0 0 1]
cam1=[{f} 0 {cx1}; 0 {f} {cy}; 0 0 1]
doffs={doffs}
baseline={baseline_mm}
width={width}
height={height}
ndisp={ndisp}
isint=0
"""


def write_scene(folder: Path, scene: PlanePair) -> None:
    """A scene in the layout of MiddEval3."""
    folder.mkdir(parents=True)
    camera = scene.pair.camera
    for name, grey in (("im0.png", scene.pair.left), ("im1.png", scene.pair.right)):
        write_image(folder / name, np.repeat(grey[:, :, None], 3, axis=2))
    write_pfm(folder / "disp0GT.pfm", scene.truth.values)
    write_image(folder / "mask0nocc.png", np.where(scene.truth.nonocc, 255, 128).astype(np.uint8))
    values = {"f": camera.focal_px, "cx": camera.cx_px, "cy": camera.cy_px, "ndisp": NDISP}
    values |= {"cx1": camera.cx_right_px, "doffs": camera.doffs_px, "width": WIDTH_PX}
    values |= {"baseline_mm": 1000 * camera.baseline_m, "height": HEIGHT_PX}
    (folder / "calib.txt").write_text(CALIB.format(**values))


@pytest.fixture(scope="module", autouse=True)
def coarse_figures() -> Iterator[None]:
    """Draw few facets and few pixels: matplotlib takes most of the time of these tests for them."""
    draw = Figure.savefig
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper_page, "_SURFACE_COLUMNS", 30)
        patch.setattr(Figure, "savefig", lambda *to, **options: draw(*to, **options, dpi=30))
        yield


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # doffs 10: disparities of 5 to 20 px lie at 180 · 0.2 / (d + 10) = 2.4 to 1.2 m.
    camera = RectifiedCamera(180.0, 55.0, 40.0, 65.0, 0.2, WIDTH_PX, HEIGHT_PX, NDISP)
    folder = tmp_path_factory.mktemp("trainingQ")
    write_scene(folder / "ArtL", step_pair(camera, 1.3, 2.0, 20.0, seed=1))
    write_scene(folder / "Jadeplant", slanted_pair(camera, 1.6, (0.3, 0.0), seed=2))
    write_scene(folder / "Pipes", slanted_pair(camera, 1.5, (0.0, -0.2), seed=3))
    return folder


@pytest.fixture(scope="module")
def run(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("paper") / "run"
    options = ("--as-printed", "--set", "paper.patches_px=[3,7,11]", "--json")
    done = refusals.run("paper", scenes, *options, "--out", out)
    assert done.code == 0, done.err
    return out, json.loads(done.out)


def test_every_product_is_there(run: tuple[Path, dict[str, Any]]) -> None:
    out, _ = run
    files = {p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file()}
    expected = {"report.html", "summary.json", "run.json", "config.yaml"}
    for folder in ("experiment_2_ArtL", "experiment_3_Jadeplant", "experiment_4_Pipes"):
        expected.add(f"{folder}/clouds.mlp")
        for method in ("corrected", "absolute", "as_printed"):
            expected |= {f"{folder}/{method}/{name}" for name in PER_METHOD}
    assert files == expected
    assert set(json.loads((out / "run.json").read_text())["files"]) == files
    assert json.loads((out / "run.json").read_text())["inputs"]["files"] == 15


def test_only_the_corrected_method_has_the_right_depth(run: tuple[Path, dict[str, Any]]) -> None:
    for experiment in run[1]["experiments"].values():
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


def test_table_1_is_read_from_the_scenes(run: tuple[Path, dict[str, Any]]) -> None:
    row = run[1]["table_1"][0]
    assert row["printed"] == {"focal_length": 10.0, "baseline_mm": 200.0, "ndisp": NDISP}
    assert row["corrected"]["focal_px"] == 180.0
    assert 83 < row["depth_error_of_printed_percent"] < 92


def test_ascii_and_binary_clouds_are_the_same(run: tuple[Path, dict[str, Any]]) -> None:
    folder = run[0] / "experiment_2_ArtL" / "corrected"
    binary, text = read_ply(folder / "cloud.ply"), read_ply(folder / "cloud_ascii.ply")
    assert len(binary) > 1000
    assert np.allclose(binary.xyz, text.xyz, rtol=1e-5)  # text has fewer digits


def test_printed_depth_is_doffs_times_baseline_over_disparity(
    run: tuple[Path, dict[str, Any]],
) -> None:
    folder = run[0] / "experiment_3_Jadeplant" / "absolute"
    disparity, depth = read_pfm(folder / "disparity.pfm"), read_pfm(folder / "depth.pfm")
    known = np.isfinite(depth)
    assert np.array_equal(known, np.nan_to_num(disparity) > 0)  # disparity 0 would be infinite
    assert np.allclose(depth[known], 10 * 0.2 / disparity[known], rtol=1e-6)


def test_its_configuration_gives_the_same_figures(
    scenes: Path, run: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    printed = run[1]["experiments"]
    assert json.loads((run[0] / "summary.json").read_text())["experiments"] == printed
    config = load_config(run[0] / "config.yaml", ["paper.as_printed=false"])
    again = run_paper(scenes, config, out=tmp_path / "again", threads=1)
    assert next(iter(headline(again))) == "2 ArtL, corrected"
    for number, one in again["experiments"].items():
        for kind in ("methods", "patches"):
            assert one[kind] == {"corrected": printed[number][kind]["corrected"]}


def test_a_scene_without_truth_is_reconstructed_and_told(scenes: Path, tmp_path: Path) -> None:
    copy = tmp_path / "scenes"
    for file in scenes.rglob("*"):
        if file.is_file() and not (file.parent.name == "ArtL" and file.suffix == ".pfm"):
            target = copy / file.relative_to(scenes)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
    options = ("--set", "paper.patches_px=[5]", "--out", tmp_path / "out", "--json")
    done = refusals.run("paper", copy, *options)
    assert done.code == 0, done.err
    summary = json.loads(done.out)
    assert summary["experiments"]["2"]["methods"]["corrected"]["disparity"] is None
    assert len(summary["warnings"]) == 1


@pytest.mark.parametrize(
    ("arguments", "named"), [((), "RECON_DATA"), (("scenes",), "Jadeplant, Pipes")]
)
def test_missing_scenes_are_reported_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], named: str
) -> None:
    monkeypatch.delenv("RECON_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes" / "ArtL").mkdir(parents=True)
    refusals.assert_refused(refusals.run("paper", *arguments, "--out", "out", "--json"), named)
    assert not (tmp_path / "out").exists()
