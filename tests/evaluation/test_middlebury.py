"""Middlebury's metrics against plain implementations, and against published values."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.commands.evaluate_middlebury import run_middlebury
from recon.core.errors import EvaluationError, SettingsError, ShapeError, SourceError
from recon.core.values import Disparity, DisparityTruth, Reason, RectifiedPair
from recon.evaluation.middlebury import bench, score
from recon.io.images.disparity import read_pfm, write_pfm
from recon.stereo.frame import StereoSettings
from tests.evaluation.test_disparity import made
from tests.scenery.middlebury import square, write_scene

N = float("nan")
SHAPE = (60, 100)


def plain_figures(disp, gt, mask, ndisp, rounded, full):
    """What SDK 1.6 describes, in loops: infinity is unknown, limits are in full-size pixels."""
    scale = gt.shape[1] // disp.shape[1]
    n = invalid = 0
    errors = []
    for y in range(gt.shape[0]):
        for x in range(gt.shape[1]):
            if math.isinf(gt[y, x]) or (mask is not None and mask[y, x] != 255):
                continue
            n += 1
            d = scale * float(disp[y // scale, x // scale])
            if math.isinf(d):
                invalid += 1
                continue
            d = max(0.0, min(float(scale * ndisp), d))
            if rounded:
                d = math.floor(d + 0.5)
            errors.append(abs(d - float(gt[y, x])) * full)
    errors.sort()
    figures = {f"bad{t}": 100 * sum(e > t for e in errors) / n for t in (0.5, 1, 2, 4)}
    figures["invalid"] = 100 * invalid / n
    figures["avgerr"] = sum(errors) / len(errors)
    figures["rms"] = math.sqrt(sum(e * e for e in errors) / len(errors))
    for q in (50, 90, 95, 99):
        figures[f"a{q}"] = errors[math.ceil(q / 100 * len(errors)) - 1]
    return figures


@given(
    seed=st.integers(0, 2**16),
    scale=st.sampled_from([1, 2, 4]),
    full=st.sampled_from([1, 2, 4]),
    rounded=st.booleans(),
    masked=st.booleans(),
)
def test_figures_are_those_of_the_plain_definitions(seed, scale, full, rounded, masked):
    rng = np.random.default_rng(seed)
    # Multiples of 1/4 are exact, so errors of exactly a limit occur and must not be bad.
    gt = (rng.integers(0, 80 * scale, (12, 16)) / 4).astype(np.float32)
    small = gt[::scale, ::scale] / scale + rng.integers(-12, 13, (12 // scale, 16 // scale)) / 4
    disp = small.astype(np.float32)
    disp[rng.random(disp.shape) < 0.2] = np.inf
    disp[0, 0] = 3.0
    gt[rng.random(gt.shape) < 0.2] = np.inf
    gt[0, 0] = 3.0
    mask = np.where(rng.random(gt.shape) < 0.8, 255, 128)
    mask[0, 0] = 255
    expected = plain_figures(disp, gt, mask if masked else None, 20, rounded, full)

    truth = DisparityTruth(np.where(np.isinf(gt), np.float32(np.nan), gt), mask == 255)
    rules = score.MiddleburyRules(full_size_factor=full, largest_px=20.0 * scale, isint=rounded)
    values = np.where(np.isinf(disp), np.float32(np.nan), disp)
    found = score.evaluate_middlebury(values, truth, rules, occluded=not masked)

    named = {f"bad{t:g}": ratio for t, ratio in found.bad.items()}
    named |= {"invalid": found.invalid, "avgerr": found.avgerr_px, "rms": found.rms_px}
    named |= {f"a{q}": error for q, error in found.quantiles_px.items()}
    # float32 in, float64 sums: what differs is the order of addition.
    assert named == pytest.approx(expected, rel=1e-6, abs=1e-9)


def plainly_filled(row: list[float]) -> list[float]:
    """The rule for one row, pixel by pixel: the smaller of both neighbours, or the only one."""
    out = []
    for x, value in enumerate(row):
        left = next((v for v in row[:x][::-1] if not math.isnan(v)), None)
        right = next((v for v in row[x + 1 :] if not math.isnan(v)), None)
        beside = [v for v in (left, right) if v is not None]
        out.append(min(beside) if math.isnan(value) else value)
    return out


@given(st.integers(0, 2**16), st.integers(1, 12))
def test_known_values_stay_and_holes_follow_the_rule(seed, width):
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 50, (5, width)).astype(np.float32)
    values[rng.random(values.shape) < 0.6] = np.nan
    values[:, rng.integers(width)] = 7
    expected = [plainly_filled(row) for row in values.tolist()]
    assert score.fill_holes(values).tolist() == expected


def test_rows_without_values_are_filled_and_results_taken_to_the_size_of_the_truth():
    rows = [[N, N], [1, N], [N, N], [N, 2], [N, N], [N, N]]
    filled = score.fill_holes(np.array(rows, np.float32))
    assert filled[:, 0].tolist() == [1, 1, 1, 2, 2, 2]
    assert np.isnan(score.fill_holes(np.full((2, 2), N, np.float32))).all()
    with pytest.raises(ShapeError, match="values"):
        score.fill_holes(np.zeros((2, 2)))
    values = np.arange(24, dtype=np.float32).reshape(4, 6)
    assert score.at_truth_size(values, (2, 3)).tolist() == [[0, 1, 2], [6, 7, 8]]
    smaller = score.at_truth_size(np.array([[1, N]], dtype=np.float32), (2, 4))
    assert np.array_equal(smaller, [[2, 2, N, N], [2, 2, N, N]], equal_nan=True)
    for shape in ((5, 7), (6, 8), (5, 8)):
        assert score.at_truth_size(np.ones(shape, np.float32), (3, 4)).shape == (3, 4)
    with pytest.raises(EvaluationError, match="differ in size"):
        score.at_truth_size(np.ones((10, 10), np.float32), (10, 15))


@pytest.mark.parametrize(
    ("factor", "error_px", "right", "within"), [(2, 0.75, 1, 0), (4, 0.25, 1, 1), (4, 1.25, 0, 0)]
)
def test_a_map_larger_than_the_truth_is_judged_in_its_own_pixels(factor, error_px, right, within):
    """Off by 0.75 of its own pixels is right; at half the size that is 0.375 px of the truth."""
    small = tuple(n // factor for n in SHAPE)
    truth = DisparityTruth(np.full(small, 20 / factor, np.float32), np.ones(small, bool))
    figures = score.confidence_figures(made(np.full(SHAPE, error_px))[0], truth)
    assert (figures["reliability"]["right"][8], figures["within_1_sigma"]) == (right, within)


def test_the_mean_counts_scenes_by_weight_and_leaves_out_those_without():
    """PianoL counts half: two thirds and one third."""
    estimate, truth = made(np.zeros(SHAPE))
    nothing = score.confidence_figures(
        estimate.reject(np.ones(SHAPE, bool), Reason.AMBIGUOUS), truth
    )
    assert nothing is None
    assert score.weighted_confidence({"Piano": None}) is None
    right, wrong = (
        score.confidence_figures(*made(np.full(SHAPE, error_px))) for error_px in (0, 5)
    )
    mean = score.weighted_confidence({"Piano": right, "PianoL": wrong, "Teddy": nothing})
    assert mean["ece"] == pytest.approx(2 / 3 * 0.2 + 1 / 3 * 0.8, abs=1e-6)
    assert mean["within_1_sigma"] == pytest.approx(2 / 3)
    # 1e-5: the lists have six digits.
    assert mean["reliability"]["right"][8] == pytest.approx(2 / 3, abs=1e-5)
    assert mean["sparsification"]["wrong"][0] == pytest.approx(1 / 3, abs=1e-5)
    halved = {"PianoL", "Playroom", "Playtable", "Shelves", "Vintage", "trainingQ/Playroom"}
    assert {score.scene_weight(name) for name in halved} == {4}
    assert {score.scene_weight(name) for name in ("PlaytableP", "Piano", "Teddy")} == {8}
    assert score.weighted_figures({"Teddy": 10.0, "Vintage": 40.0}) == pytest.approx(20.0)


class Shifted:
    """A matcher that finds the truth of a scene, 1 px too far, with one confidence for all."""

    name = "shifted"

    def __init__(self, values: np.ndarray) -> None:
        self.values = values + np.float32(1)

    def match(self, pair: RectifiedPair) -> Disparity:
        return Disparity.from_values(self.values[: pair.left.shape[0]])


def test_scenes_and_results_of_a_folder_become_figures(tmp_path):
    for name in ("Teddy", "Vintage"):
        write_scene(tmp_path / "trainingQ" / name, square())
    paths = bench.find_scenes(tmp_path / "trainingQ")
    scenes = {name: bench.read_scored_scene(name, path, None) for name, path in paths.items()}
    teddy = scenes["Teddy"]
    true, submitted = teddy.truth.values, tmp_path / "theirs" / "trainingQ" / "Teddy"
    write_pfm(submitted / "disp0X.pfm", true + np.float32(0.5))
    (submitted / "timeX.txt").write_text("1.5\n")
    (theirs,) = bench.find_results([tmp_path / "theirs"], paths, ["shifted"])
    (named,) = bench.find_results([tmp_path / "theirs"], paths, ["theirs"])
    assert (theirs.name, named.name) == ("theirs", f"{tmp_path.name}/theirs")
    given = bench.read_result(theirs, teddy)
    assert bench.read_result(theirs, scenes["Vintage"]) is None
    (own,) = bench.Bench([Shifted(true)], StereoSettings(), 1).results(teddy)
    figures = {"Teddy": {"shifted": own.figures, "theirs": given.figures}, "Vintage": None}
    summary = bench.summarise_scenes(figures, ["shifted", "theirs"], [theirs], tmp_path).to_json()
    for name, error_px in (("shifted", 4.0), ("theirs", 2.0)):
        mask = summary["matchers"][name]["weighted"]["nonocc"]
        # A pixel is four full-size ones here; what is exactly off by a limit is not bad.
        assert mask["dense"]["avgerr"] == mask["sparse"]["rms"] == pytest.approx(error_px)
        assert (mask["dense"]["bad"]["4"], mask["dense"]["bad"]["1"]) == (0, 100)
        assert mask["dense"]["depth"]["median_m"] > 0
        assert (mask["invalid"], own.figures["confidence"]) == (0, None)
    assert summary["matchers"]["theirs"]["weighted"]["seconds"] == 1.5
    assert summary["matchers"]["shifted"]["weighted"]["seconds"] >= 0
    assert (summary["skipped"], summary["mean_over"]) == (["Vintage"], ["Teddy"])
    assert (teddy.camera.ndisp or 0) > np.nanmax(true)
    assert score.error_map(teddy, own.disparity.values)[np.isfinite(true)] == pytest.approx(4.0)


class Both:
    """A matcher that measures the truth at left, and infers what is 4 px off at right."""

    name = "both"

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def match(self, pair: RectifiedPair) -> Disparity:
        values, middle = self.values[: pair.left.shape[0]].copy(), pair.left.shape[1] // 2
        values[:, middle:] += 4
        known, inferred = np.isfinite(values), np.arange(values.shape[1]) >= middle
        reason = np.where(inferred, np.uint8(Reason.FILLED), np.uint8(Reason.VALID))
        sure = np.where(inferred, np.float32(0.25), np.float32(1))
        return Disparity(
            values, np.where(known, sure, 0), values, np.where(known, reason, np.uint8(6))
        )


def test_what_was_measured_and_what_was_inferred_are_scored_apart(tmp_path):
    folder, out = tmp_path / "trainingQ", tmp_path / "out"
    write_scene(folder / "Teddy", square())
    true = bench.read_scored_scene("Teddy", folder / "Teddy", None).truth.values
    summary = run_middlebury(folder, matchers=[Both(true)], out=out).to_json()
    (found,) = summary["matchers"].values()
    for figures in (found["weighted"], found["scenes"]["Teddy"]):
        measured, inferred = (figures["all"][kind] for kind in ("measured", "inferred"))
        assert (measured["bad"]["2"], measured["wrong"]) == (0, 0)
        # Four pixels of the map are sixteen full-size ones.
        assert (inferred["bad"]["2"], inferred["wrong"]) == (100, 100)
        assert inferred["avgerr"] == pytest.approx(16)
        assert {*measured["bad"]} == {"0.5", "1", "2", "4"}
        assert measured["ratio"] + inferred["ratio"] + figures["all"]["invalid"] == (
            pytest.approx(100)
        )
        assert 0 < inferred["ratio"] < 100
        assert figures["all"]["sparse"]["bad"]["2"] == pytest.approx(inferred["ratio"])
        rated = figures["confidence"]
        assert (rated["ece_measured"], rated["ece_inferred"]) == pytest.approx((0, 0.25))
    text = (out / "tables.txt").read_text()
    assert "both, inferred" in text
    assert "both, measured" in (out / "report.html").read_text()
    maps = [read_pfm(out / f"disparity/both/Teddy{name}.pfm") for name in ("", "_inferred")]
    middle = true.shape[1] // 2
    np.testing.assert_array_equal(maps[0][:, :middle], true[:, :middle])
    np.testing.assert_array_equal(maps[1][:, middle:], true[:, middle:] + 4)
    assert not np.isfinite(maps[0][:, middle:]).any()
    assert not np.isfinite(maps[1][:, :middle]).any()


def test_results_that_are_none_several_or_given_twice_are_refused(tmp_path):
    write_scene(tmp_path / "Teddy", square())
    paths = bench.find_scenes(tmp_path)
    for folder, names, message in (
        ("none", (), "no result for any scene"),
        ("several", ("disp0A.pfm", "disp0B.pfm", "disp0B_s.pfm"), "several results"),
    ):
        for name in names or ("other.pfm",):
            write_pfm(tmp_path / folder / "Teddy" / name, np.zeros((2, 2), np.float32))
        with pytest.raises(SourceError, match=message):
            bench.find_results([tmp_path / folder], paths, [])
    with pytest.raises(SettingsError, match="given twice"):
        bench.find_results([tmp_path / "none", tmp_path / "none"], paths, [])
    with pytest.raises(SourceError, match="no Middlebury scene"):
        bench.find_scenes(tmp_path / "none")


# Measured elsewhere with OpenCV 5 on all 15 scenes of the table, of which 8 are here: bad1, bad2,
# bad4, avgerr. The fractions of single scenes vary by 10 to 30, so means of 8 and 15 may differ.
ANCHORS = {"opencv-bm": (42.4, 28.6, 21.1, 12.2), "opencv-sgbm": (40.3, 23.0, 15.3, 7.7)}


@pytest.mark.real
def test_opencv_scores_as_it_was_measured_elsewhere(recon_data, tmp_path):
    folder = recon_data / "middlebury" / "MiddEval3" / "trainingQ"
    found = run_middlebury(folder, matchers=tuple(ANCHORS), out=tmp_path / "run").to_json()[
        "matchers"
    ]
    for matcher, anchors in ANCHORS.items():
        assert len(found[matcher]["scenes"]) == 8
        dense = found[matcher]["weighted"]["nonocc"]["dense"]
        figures = (*(dense["bad"][limit] for limit in ("1", "2", "4")), dense["avgerr"])
        for value, anchor in zip(figures, anchors, strict=True):
            assert 0.75 * anchor < value < 1.3 * anchor
    # Limits are full-size pixels: bad 0.5 is an eighth of a pixel here.
    assert 50 < dense["bad"]["0.5"] < 75
    assert dense["a50"] < 1.0
