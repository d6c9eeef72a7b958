"""Matchers that are not ours: OpenCV's, objects, and plug-ins that packages register."""

import sys

import cv2
import numpy as np
import pytest

import recon
from recon.commands.config import list_settings, load_config
from recon.core.errors import MatchingError, SettingsError
from recon.core.values import Disparity, Reason, RectifiedCamera, RectifiedPair
from recon.io.middlebury import stand_in_camera
from recon.stereo.match.light import EveningMatcher
from recon.stereo.match.opencv import OpencvMatcher, OpencvSettings
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.registry import MATCHERS, MatchingSettings, make_matcher
from recon.stereo.match.search import SearchSettings

pytestmark = pytest.mark.portable


def install_plugin(site, package, modules, points, group="matchers"):
    """Write modules and metadata of a package with entry points into a folder of packages."""
    for name, source in modules.items():
        (site / name).write_text(source)
    info = site / f"{package.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    lines = "".join(f"{name} = {value}\n" for name, value in points.items())
    (info / "entry_points.txt").write_text(f"[recon.{group}]\n{lines}")


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


def altered(**fields: float | np.ndarray) -> Disparity:
    made = Disparity.from_values(np.full(SHAPE, 5.0))
    arrays = {name: getattr(made, name) for name in ("values", "confidence", "sigma_px", "reason")}
    for name, given in fields.items():
        arrays[name] = np.broadcast_to(given, SHAPE).astype(arrays[name].dtype)
    return Disparity(**arrays)


def test_an_object_is_taken_where_a_name_is_and_recorded_by_its_name(tmp_path):
    mine, out = Flat(), tmp_path / "run"
    config = recon.load_config(overrides=["cloud.remove_flying_edges=false"]).with_matcher(mine)
    given = recon.PairInput(recon.StereoPair(image(0), image(1)), CAMERA)
    for found in (
        recon.match(image(), image(), matcher=mine),
        recon.reconstruct(image(), image(), CAMERA, matcher=mine).disparity,
        recon.reconstruct(image(), image(), CAMERA, config).disparity,
        recon.run_disparity(given, config, out=out).disparity,
    ):
        assert np.nanmedian(found.values) == 5
    assert "matcher: Flat" in (out / "config.yaml").read_text()


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (np.ones(SHAPE), "returns no Disparity.*ndarray float64.*from_values"),
        (7, "returns no Disparity.*int"),
        (Disparity.from_values(np.ones((3, 4))), r"size of the images.*\(3, 4\).*\(20, 60\)"),
        (altered(confidence=1.5), "confidence is out of range.*1.5"),
        (altered(confidence=np.nan), "confidence is out of range.*NaN"),
        (altered(sigma_px=np.nan), "standard deviation is out of range.*NaN"),
        (altered(sigma_px=0), "standard deviation is out of range.*0 to 0"),
        (altered(values=np.inf, reason=np.full(SHAPE, 2, np.uint8)), "infinite.*expected NaN"),
    ],
)
def test_what_is_no_disparity_of_the_pair_is_refused(found, words):
    with pytest.raises(MatchingError, match=rf"^matcher 'Flat': .*{words}"):
        recon.match(image(), image(), matcher=Flat(found))


def test_an_error_inside_is_reported_with_its_matcher_and_kept_as_the_cause():
    class Broken(Flat):
        name = "mine"

        def match(self, pair: RectifiedPair) -> Disparity:
            raise ZeroDivisionError("by zero")

    words = r"'mine': the matcher fails.*ZeroDivisionError"
    with pytest.raises(MatchingError, match=words) as raised:
        recon.match(image(), image(), matcher=Broken())
    assert isinstance(raised.value.__cause__, ZeroDivisionError)


@pytest.mark.parametrize("code", [0, 1, None, "done"])
def test_a_matcher_that_exits_ends_nothing(code):
    class Exiting(Flat):
        def match(self, pair: RectifiedPair) -> Disparity:
            sys.exit(code)

    with pytest.raises(MatchingError, match=r"'Exiting': the matcher fails.*SystemExit"):
        recon.match(image(), image(), matcher=Exiting())


def test_no_match_is_kept_where_there_is_no_image_and_the_range_is_named():
    valid, mine = np.ones(SHAPE, bool), Flat()
    valid[:, :9] = False
    found = make_matcher(mine).match(RectifiedPair(image(), image(), CAMERA, valid=valid))
    assert np.array_equal(found.valid, valid)
    assert all(isinstance(make_matcher(name, threads=1), Matcher) for name in MATCHERS)
    assert mine.ndisp >= 1


@pytest.mark.parametrize(
    ("given", "settings", "word"),
    [
        (Flat, {}, r"class.*Flat\(\)"),
        (7, {}, "not usable as matcher.*int"),
        (Flat(), {"ndisp": 16}, r"takes no settings here.*ndisp"),
    ],
)
def test_what_is_no_matcher_or_takes_no_settings_is_refused(given, settings, word):
    with pytest.raises(SettingsError, match=word):
        recon.match(image(), image(), matcher=given, **settings)  # type: ignore[arg-type]


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

def leaves():
    raise SystemExit(0)

class Ends:
    def match(self, pair):
        raise SystemExit(0)
"""


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    places = {"flat": "Flat", "sad": "Flat", "missing": "Nowhere", "ends": "Ends"}
    names = {name: f"flat_matcher:{place}" for name, place in places.items()}
    names |= {name: f"flat_matcher:{name}" for name in ("nothing", "fails", "leaves")}
    names |= {"gone": "not_there:Flat", "exiting": "exiting_matcher:Flat"}
    modules = {"flat_matcher.py": FLAT, "exiting_matcher.py": "import sys\nsys.exit(0)\n"}
    install_plugin(tmp_path, "flat-matcher", modules, names)
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("plugin")
def test_a_registered_matcher_has_a_name_that_is_not_ours_nor_of_two(tmp_path):
    assert np.nanmedian(recon.match(image(), image(), matcher="flat").values) == 7
    made = make_matcher("sad", MatchingSettings(ndisp=16))
    assert isinstance(made, EveningMatcher)
    with pytest.raises(SettingsError, match=r"unknown matcher.*'cencus'.*fails, fine, flat.*sad"):
        recon.match(image(), image(), matcher="cencus")
    install_plugin(tmp_path, "other-matcher", {}, {"flat": "other_matcher:Flat"})
    with pytest.raises(SettingsError, match=r"same name.*flat-matcher.*and.*other-matcher"):
        recon.match(image(), image(), matcher="flat")


@pytest.mark.usefixtures("plugin")
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("missing", "does not load.*AttributeError.*Nowhere"),
        ("gone", "does not load.*ModuleNotFoundError.*not_there"),
        ("nothing", "makes no matcher.*int"),
        ("fails", "does not load.*RuntimeError: no model here"),
        ("leaves", "does not load.*SystemExit: 0"),
        ("exiting", "does not load.*SystemExit: 0"),
    ],
)
def test_a_broken_plugin_is_named_in_one_line(name, words):
    with pytest.raises(SettingsError, match=words) as raised:
        recon.match(image(), image(), matcher=name)
    assert f"matcher {name!r}" in str(raised.value)
    assert "of package flat-matcher" in str(raised.value)


SET = """
import numpy as np
from pydantic import Field
from recon import Disparity
from recon.core.settings import Settings

class LevelSettings(Settings):
    \"\"\"How a level is guessed.\"\"\"

    level_px: float = Field(7.0, ge=0.0, le=100.0)
    \"\"\"Disparity of every pixel.\"\"\"

class Level:
    settings = LevelSettings

    def __init__(self, settings):
        self.level_px = settings.level_px

    def match(self, pair):
        return Disparity.from_values(np.full(pair.left.shape, self.level_px))
"""


@pytest.fixture
def with_settings(tmp_path, monkeypatch):
    points = {"my-level": "level_matcher:Level"}
    install_plugin(tmp_path, "level-matcher", {"level_matcher.py": SET}, points)
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("with_settings")
def test_the_settings_that_a_plugin_brings_are_checked_shown_recorded_and_handed_to_it():
    changes = ["matching.matcher=my-level", "matching.my_level.level_px=3"]
    config = load_config(None, changes)
    found = make_matcher("my-level", config.matching).match(shifted_pair(0))
    assert np.nanmax(found.values) == 3
    assert np.nanmedian(recon.match(image(), image(), matcher="my-level").values) == 7
    assert np.nanmedian(recon.match(image(), image(), matcher="my-level", level_px=2).values) == 2
    own = {"my_level": {"level_px": 3.0}}
    assert config.recorded("pair")["matching"] == {"matcher": "my-level", **own}
    assert load_config(config.model_dump(mode="json")) == config
    assert load_config(config, {"matching.window_px": 9}).matching.my_level.level_px == 3
    with pytest.raises(SettingsError, match=r"'matching\.my_level\.level_px': .*greater than"):
        load_config(None, ["matching.my_level.level_px=-1"])
    with pytest.raises(SettingsError, match=r"unknown setting 'matching\.my_level\.levels'"):
        load_config(None, ["matching.my_level.levels=1"])
    (group,) = list_settings("matching.my_level")
    assert (group.name, group.purpose) == ("matching.my_level", "How a level is guessed.")
    assert [one.default for one in group.settings] == ["7"]


def test_settings_of_a_matcher_that_is_not_installed_are_refused_by_name():
    with pytest.raises(SettingsError, match=r"unknown setting 'matching\.my_level\.level_px'"):
        load_config(None, ["matching.my_level.level_px=3"])


NAMES = ("opencv-bm", "opencv-sgbm")
BOTH = pytest.mark.parametrize("name", NAMES)


def shifted_pair(shift_px: int, shape: tuple[int, int] = (60, 160)) -> RectifiedPair:
    """Noise, seen by the right camera ``shift_px`` further left."""
    height, width = shape
    world = np.random.default_rng(3).integers(0, 256, (height, width + 64), dtype=np.uint8)
    world = cv2.GaussianBlur(world, (3, 3), 0)
    left, right = world[:, 32 : 32 + width], world[:, 32 + shift_px : 32 + shift_px + width]
    return RectifiedPair(left, right, stand_in_camera(width, height, 32))


def match(name: str, pair: RectifiedPair, *, pad: bool = True, **settings: object) -> Disparity:
    searched, opencv = SearchSettings.parse(settings), OpencvSettings(pad=pad)
    matcher = OpencvMatcher(searched, opencv, semi_global=name == NAMES[1])
    return matcher.match(pair)


@BOTH
@pytest.mark.parametrize("shift_px", [-6, 0, 7, 20])
def test_a_shift_is_found_wherever_the_right_image_reaches(name, shift_px):
    first = -16 if shift_px < 0 else 0
    found = match(name, shifted_pair(shift_px), min_disparity_px=first).values
    # A 16th is OpenCV's step; ten of them allow for the bias of its sub-pixel fit.
    inner = found[5:-5, max(0, shift_px) + 5 : min(0, shift_px) - 5]
    assert np.nanmax(np.abs(inner - shift_px)) < 10 / 16
    assert np.isfinite(inner).mean() > 0.95


@BOTH
def test_nothing_is_matched_beside_the_right_image_without_an_image_or_padding(name):
    assert not OpencvSettings().pad  # the baseline is OpenCV as it comes
    assert np.isnan(match(name, shifted_pair(7), pad=False).values[:, :31]).all()
    pair, valid = shifted_pair(20), np.ones((60, 160), dtype=bool)
    valid[:10] = False
    found = match(name, RectifiedPair(pair.left, pair.right, pair.camera, valid=valid))
    there = np.arange(160) - found.values
    assert np.nanmin(there) >= -0.5
    assert np.nanmax(there) <= 159.5
    assert (found.reason[:10] == Reason.BORDER).all()


@BOTH
def test_what_opencv_could_not_match_is_nan_with_a_reason_and_tiny_images_no_error(name):
    left, right = np.random.default_rng(5).integers(0, 256, (2, 60, 160), dtype=np.uint8)
    disparity = match(name, RectifiedPair(left, right, stand_in_camera(160, 60, 32)))
    # Chance matches some 9 % of noise.
    assert 0.85 < np.isnan(disparity.values).mean() < 0.95
    assert Reason.AMBIGUOUS in disparity.reason
    assert not (disparity.values < 0).any()
    for height, width in ((1, 1), (1, 40), (40, 1), (3, 3)):
        tiny = left[:height, :width]
        pair = RectifiedPair(tiny, tiny, stand_in_camera(width, height))
        assert match(name, pair).values.shape == (height, width)


@pytest.mark.parametrize(
    ("name", "shape", "settings", "words"),
    [
        ("opencv-bm", (6, 20), {"window_px": 21}, "20x6"),
        ("opencv-sgbm", (60, 160), {"min_disparity_px": -4096}, "exceed the range of OpenCV"),
        ("opencv-sgbm", (60, 160), {"ndisp": 4096}, "exceed the range of OpenCV"),
    ],
)
def test_what_opencv_refuses_or_cannot_count_is_an_error_of_ours(name, shape, settings, words):
    with pytest.raises(MatchingError, match=words):
        match(name, shifted_pair(0, shape), pad=False, **settings)
