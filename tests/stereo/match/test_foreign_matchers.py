"""Matchers that are not ours: objects, and plug-ins that packages register."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import recon
from recon.core.errors import MatchingError, SettingsError
from recon.core.values import Disparity, RectifiedCamera, RectifiedPair
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.registry import MATCHERS, MatchingSettings, make_matcher
from tests.stereo.match.plugins import install_plugin

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SHAPE = (20, 60)
CAMERA = RectifiedCamera(100.0, 30.0, 10.0, 30.0, 0.1, SHAPE[1], SHAPE[0])


class Flat:
    """Finds the same disparity everywhere, or returns whatever it is given."""

    def __init__(self, found: object = None) -> None:
        self.found = found
        self.ndisp: int | None = None

    def match(self, pair: RectifiedPair) -> Disparity:
        self.ndisp = pair.camera.ndisp
        values = np.full(pair.left.shape, 5.0)
        return Disparity.from_values(values) if self.found is None else self.found  # type: ignore[return-value]


def image(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, SHAPE, dtype=np.uint8)


def altered(**fields: np.ndarray) -> Disparity:
    made = Disparity.from_values(np.full(SHAPE, 5.0))
    arrays = {name: getattr(made, name) for name in ("values", "confidence", "sigma_px", "reason")}
    return Disparity(**{**arrays, **fields})


def full(number: float, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    return np.full(shape, number, np.float32)


def test_an_object_is_taken_where_a_name_is() -> None:
    mine = Flat()
    config = recon.load_config(overrides=["cloud.remove_flying_edges=false"]).with_matcher(mine)
    for found in (
        recon.match(image(), image(), matcher=mine),
        recon.reconstruct(image(), image(), CAMERA, matcher=mine).disparity,
        recon.reconstruct(image(), image(), CAMERA, config).disparity,
    ):
        assert np.nanmedian(found.values) == 5
    assert MatchingSettings(matcher=mine).matcher is mine
    assert config.model_dump(mode="json")["matching"]["matcher"] == "Flat"


def test_a_run_is_made_with_an_object_and_records_its_name(tmp_path: Path) -> None:
    config = recon.load_config().with_matcher(Flat())
    given = recon.PairInput(recon.StereoPair(image(0), image(1)), CAMERA)
    out = tmp_path / "run"
    run = recon.run_disparity(given, config, out=out)
    assert np.nanmedian(run.disparity.values) == 5
    assert "matcher: Flat" in (out / "config.yaml").read_text()


@pytest.mark.slow
def test_a_drive_is_mapped_with_an_object() -> None:
    small = ["frames=3", "width_px=256", "height_px=96", "focal_px=150"]
    config = recon.load_config(overrides=[f"street.{setting}" for setting in small])
    mine = Flat()
    mapped = recon.map_sequence(recon.SyntheticSource(config.street), config.with_matcher(mine))
    assert len(mapped.trajectory) == 3
    assert mine.ndisp is not None


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (np.ones(SHAPE), "returns no Disparity.*ndarray float64.*from_values"),
        (7, "returns no Disparity.*int"),
        (Disparity.from_values(np.ones((3, 4))), r"size of the images.*\(3, 4\).*\(20, 60\)"),
        (altered(confidence=full(1.5)), "confidence is out of range.*1.5"),
        (altered(confidence=full(np.nan)), "confidence is out of range.*NaN"),
        (altered(sigma_px=full(np.nan)), "standard deviation is out of range.*NaN"),
        (altered(sigma_px=full(0)), "standard deviation is out of range.*0 to 0"),
        (
            altered(values=full(np.inf), reason=np.full(SHAPE, 2, np.uint8)),
            "infinite.*expected NaN",
        ),
    ],
)
def test_what_is_no_disparity_of_the_pair_is_refused(found: object, words: str) -> None:
    with pytest.raises(MatchingError, match=rf"^matcher 'Flat': .*{words}"):
        recon.match(image(), image(), matcher=Flat(found))


def test_an_error_inside_is_reported_with_its_matcher_and_kept_as_the_cause() -> None:
    class Broken:
        name = "mine"

        def match(self, pair: RectifiedPair) -> Disparity:
            raise ZeroDivisionError("by zero")

    with pytest.raises(
        MatchingError, match=r"'mine': the matcher fails.*ZeroDivisionError"
    ) as told:
        recon.match(image(), image(), matcher=Broken())
    assert isinstance(told.value.__cause__, ZeroDivisionError)


def test_no_match_is_kept_where_there_is_no_image_and_the_range_is_named() -> None:
    valid, mine = np.ones(SHAPE, bool), Flat()
    valid[:, :9] = False
    found = make_matcher(mine).match(RectifiedPair(image(), image(), CAMERA, valid=valid))
    assert np.array_equal(found.valid, valid)
    assert mine.ndisp is not None
    assert mine.ndisp >= 1


@pytest.mark.parametrize(("given", "word"), [(Flat, r"class.*Flat\(\)"), (7, "not a matcher.*int")])
def test_what_is_no_matcher_is_refused(given: object, word: str) -> None:
    with pytest.raises(SettingsError, match=word):
        recon.match(image(), image(), matcher=given)  # type: ignore[arg-type]


def test_settings_belong_to_our_matchers() -> None:
    with pytest.raises(SettingsError, match=r"only recon's own matchers take settings.*ndisp"):
        recon.match(image(), image(), matcher=Flat(), ndisp=16)


FLAT = """
from recon import Disparity
import numpy as np

class Flat:
    def match(self, pair):
        return Disparity.from_values(np.full(pair.left.shape, 7.0))

def nothing():
    return 5

def fails():
    raise RuntimeError("no model here")
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = {
        "flat": "flat_matcher:Flat",
        "sad": "flat_matcher:Flat",
        "missing": "flat_matcher:Nowhere",
        "gone": "not_there:Flat",
        "nothing": "flat_matcher:nothing",
        "fails": "flat_matcher:fails",
    }
    install_plugin(tmp_path, "flat-matcher", {"flat_matcher.py": FLAT}, names)
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("plugin")
def test_a_registered_matcher_has_a_name_but_not_one_of_ours() -> None:
    assert np.nanmedian(recon.match(image(), image(), matcher="flat").values) == 7
    made = make_matcher("sad", MatchingSettings.parse({"sad": {"ndisp": 16}}))
    assert type(made) is MATCHERS["sad"]
    with pytest.raises(SettingsError, match=r"unknown matcher.*'cencus'.*fails, flat.*sad, sgm"):
        recon.match(image(), image(), matcher="cencus")


@pytest.mark.usefixtures("plugin")
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("missing", "does not load.*AttributeError.*Nowhere"),
        ("gone", "does not load.*ModuleNotFoundError.*not_there"),
        ("nothing", "makes no matcher.*int"),
        ("fails", "does not load.*RuntimeError: no model here"),
    ],
)
def test_a_broken_plugin_is_named_in_one_line(name: str, words: str) -> None:
    with pytest.raises(SettingsError, match=words) as told:
        recon.match(image(), image(), matcher=name)
    assert f"matcher {name!r}" in str(told.value)
    assert "of package flat-matcher" in str(told.value)


@pytest.mark.usefixtures("plugin")
def test_two_plugins_of_one_name_are_refused(tmp_path: Path) -> None:
    install_plugin(tmp_path, "other-matcher", {}, {"flat": "other_matcher:Flat"})
    with pytest.raises(SettingsError, match=r"same name.*flat-matcher.*and.*other-matcher"):
        recon.match(image(), image(), matcher="flat")


@pytest.mark.parametrize("name", MATCHERS)
def test_a_matcher_whose_range_is_estimated_is_a_matcher(name: str) -> None:
    assert isinstance(make_matcher(name, MatchingSettings(), threads=1), Matcher)


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
