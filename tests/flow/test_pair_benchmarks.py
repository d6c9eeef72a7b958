"""What the benchmarks of pairs count, on made disparities."""

import importlib

import numpy as np
import pytest

from recon.core.values import Disparity, DisparityTruth, Reason, RectifiedPair, TriangleMesh
from recon.io.middlebury import stand_in_camera
from tests.flow.runs import ROOT

HEIGHT, WIDTH = 40, 100
EDGE = 50  # column of the step, from 10 px on the left to 30; the upper quarter is sky


@pytest.fixture
def pairs(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module("pairs")


@pytest.fixture
def scene(pairs):
    truth = np.full((HEIGHT, WIDTH), 10, np.float32)
    truth[:, EDGE:] = 30
    sky = np.zeros(truth.shape, bool)
    sky[:10] = True
    truth[sky] = np.nan
    grey = np.zeros(truth.shape, np.uint8)
    pair = RectifiedPair(grey, grey, stand_in_camera(WIDTH, HEIGHT, 64))
    return pairs.Scene(pair, DisparityTruth(truth, ~sky), sky, sky)


def made(values: np.ndarray, inferred: np.ndarray, confidence: float = 0.9) -> Disparity:
    known = np.isfinite(values)
    kind = np.where(inferred, np.uint8(Reason.FILLED), np.uint8(Reason.VALID))
    return Disparity(
        values.astype(np.float32),
        np.where(known, confidence, 0).astype(np.float32),
        np.where(known, 0.2, np.nan).astype(np.float32),
        np.where(known, kind, np.uint8(Reason.AMBIGUOUS)),
    )


def test_measured_and_inferred_are_counted_apart_and_so_is_what_lies_in_the_sky(pairs, scene):
    values = scene.truth.values.copy()
    inferred = np.zeros(values.shape, bool)
    values[10:16, :20] = np.nan
    values[20:30, :20], inferred[20:30, :20] = 14, True  # 4 px off
    values[30:35, :20], inferred[30:35, :20] = 10.5, True
    values[:5, :50], inferred[:5, :50] = 8, True
    values[5:7, :50] = 8
    found = pairs.figures(made(values, inferred), scene)
    known = 30 * WIDTH
    assert found["measured"] == pytest.approx(100 * (known - 120 - 300) / known)
    assert found["inferred"] == pytest.approx(100 * 300 / known)
    assert found["measured, off by 2"] == 0
    assert found["off by 2"] == pytest.approx(100 * 200 / (known - 120))
    assert found["inferred, off by 3"] == pytest.approx(100 * 2 / 3)
    assert found["inferred, in none"] == pytest.approx(25)
    assert found["measured, in none"] == pytest.approx(10)
    # All that is measured is right, a third of what is inferred, to a pixel.
    assert found["measured, ece"] == pytest.approx(0.1, abs=1e-6)
    assert found["inferred, ece"] == pytest.approx(0.9 - 1 / 3, abs=1e-6)


def test_the_other_side_of_a_step_is_counted_near_it_alone(pairs, scene):
    values = scene.truth.values.copy()
    none = np.zeros(values.shape, bool)
    # The near surface is too wide by 3 px; 20 px away it would be as wrong.
    values[20:, EDGE - 3 : EDGE] = 30
    values[20:, 10:20] = 30
    found = pairs.figures(made(values, none), scene)
    given = 10 * 30 + (WIDTH - 10) * 5  # 5 on either side; and 5 rows below the sky
    near = given + WIDTH * 5  # and 5 of the sky
    assert found["measured, other side"] == pytest.approx(100 * 3 * 20 / near)
    # Equal confidence says nothing of which are wrong.
    ratio = 3 * 20 / given
    assert 0.5 * ratio < found["measured, ause at steps"] < ratio
    values[20:, EDGE - 3 : EDGE] = 17  # wrong, but of neither side
    assert pairs.figures(made(values, none), scene)["measured, other side"] == 0


def test_where_nothing_is_inferred_nothing_is_said_of_it(pairs, scene):
    found = pairs.figures(made(scene.truth.values, np.zeros((HEIGHT, WIDTH), bool)), scene)
    assert found["inferred"] == found["inferred, in none"] == 0
    names = ("off by 3", "ece", "confidence", "other side", "ause at steps")
    assert {found[f"inferred, {name}"] for name in names} == {None}


def test_rows_of_scenes_that_something_was_fitted_on_are_marked(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    tuned = importlib.import_module("tuned_on")
    assert tuned.mark("`sad`", "MiddEval3") == tuned.mark("Piano, `sgm`, filled") == "¹"
    assert tuned.mark("Cones, `fine`") == "²"
    assert tuned.mark("2005, `sad`") == tuned.mark("Motorcycle, `grid`") == "¹"
    for label in ("Cones, `sad`", "street, `fine`", "Piano, `opencv-bm`", "2005, `sgm`", "seed 7"):
        assert tuned.mark(label) == ""


def test_the_area_of_curtains_is_that_of_triangles_in_which_depth_changes(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    meshes = importlib.import_module("pair_meshes")
    # Two equal halves of a square; the third triangle goes from 1 m to 1.15 m, the last to 2 m.
    corners = [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1], [0, 0, 1.15], [0, 0, 2]]
    faces = [[0, 1, 2], [0, 2, 3], [0, 1, 4], [0, 1, 5]]
    mesh = TriangleMesh(np.array(corners, np.float32), np.array(faces, np.int32))
    total = 1 + 0.15 / 2 + 1 / 2
    found = meshes.changes(mesh)
    assert found["over 10 %"] == pytest.approx(100 * (0.15 / 2 + 1 / 2) / total, rel=1e-5)
    assert found["over 20 %"] == pytest.approx(100 * (1 / 2) / total, rel=1e-5)
