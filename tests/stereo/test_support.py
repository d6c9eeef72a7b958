"""Two images that do not belong together are refused, whatever was filled in, and good ones not."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import recon
from recon.commands.config import PAIR_DEFAULTS, load_config
from recon.core.errors import MatchingError
from recon.core.values import Reason, RectifiedPair, StereoPair
from recon.core.values.arrays import UInt8
from recon.io.images.image import write_image
from recon.io.middlebury import read_middlebury_scene, stand_in_camera
from recon.sources.registry import open_source
from recon.sources.synthetic import SyntheticSource
from recon.stereo.frame import FrameReconstructor
from recon.stereo.observe import Support
from recon.street.settings import StreetScene
from tests.hostile.refusals import assert_refused, run

SMALL = {"frames": 2, "width_px": 320, "height_px": 160, "focal_px": 180.0}


def street(seed: int) -> RectifiedPair:
    source = SyntheticSource(StreetScene(seed=seed, **SMALL))
    pair = next(source.frames())
    return FrameReconstructor(source.calibration, load_config()).rectify(pair)


@pytest.fixture(scope="module")
def streets() -> tuple[RectifiedPair, RectifiedPair]:
    return street(1), street(2)


def support(pair: RectifiedPair) -> Support:
    reconstructor = FrameReconstructor(pair.camera, load_config(), threads=1)
    return reconstructor.inspect(pair)[1]


def turned(image: UInt8) -> UInt8:
    return np.ascontiguousarray(image[::-1, ::-1])


def mirrored(image: UInt8) -> UInt8:
    return np.ascontiguousarray(image[:, ::-1])


def test_a_good_pair_is_supported_many_times_beyond_chance(streets):
    for pair in streets:
        found = support(pair)
        assert found.times_chance > 3
        assert found.by_features
        assert found.warnings() == ()
        found.check(None)


@pytest.mark.parametrize("wrong", ["of another street", "upside down", "mirrored", "noise"])
def test_images_that_do_not_belong_together_are_refused(streets, wrong):
    pair, other = streets
    noise = np.random.default_rng(0).integers(0, 256, pair.right.shape, dtype=np.uint8)
    right = {
        "of another street": other.right,
        "upside down": turned(pair.right),
        "mirrored": mirrored(pair.right),
        "noise": noise,
    }[wrong]
    found = support(replace(pair, right=right, right_rgb=None, left_rgb=None))
    with pytest.raises(MatchingError, match=r"^there: nothing shows that left and right.*times"):
        found.check("there")
    assert found.warnings() != ()


def test_features_support_a_pair_whose_rows_or_exposures_differ(streets):
    """What is wrong with them is said by others: they do belong together."""
    pair, _ = streets
    lower = replace(pair, right=np.roll(pair.right, 6, axis=0), right_rgb=None)
    darker = replace(pair, right=np.uint8(0.35 * pair.right), right_rgb=None)
    for one in (lower, darker):
        support(one).check(None)


def test_nothing_is_infinitely_better_than_chance_without_a_match():
    assert Support(0.0, 0.0, 0, 0).times_chance == 0.0
    assert Support(0.1, 0.0, 0, 0).times_chance == float("inf")


def written(folder: Path, left: UInt8, right: UInt8) -> tuple[Path, Path]:
    paths = folder / "left.png", folder / "right.png"
    for path, image in zip(paths, (left, right), strict=True):
        write_image(path, image)
    return paths


@pytest.mark.parametrize("command", ["pair", "disparity"])
@pytest.mark.parametrize("matcher", ["sad", "sgm", "opencv-sgbm"])
def test_commands_refuse_them_however_much_is_filled(streets, tmp_path, command, matcher):
    images, out = written(tmp_path, streets[0].left, streets[1].right), tmp_path / "out"
    camera = ["--focal", "180", "--baseline", "0.5"] if command == "pair" else []
    ended = run(command, *images, *camera, "--matcher", matcher, "--out", out)
    assert_refused(ended, "left.png: nothing shows that left and right", "times as many")
    assert not out.exists()


def test_python_refuses_them_too(streets):
    with pytest.raises(MatchingError, match="nothing shows"):
        recon.reconstruct(streets[0].left, streets[1].right, streets[0].camera)


def plain_wall(seen: float) -> StereoPair:
    """A grey wall with noise, of which a part of the height has a texture."""
    rng = np.random.default_rng(4)
    rows = round(160 * seen)
    world = np.full((160, 360), 128.0)
    world[:rows] = cv2.GaussianBlur(rng.uniform(0, 255, (160, 360)), (0, 0), 1.5)[:rows]
    sides = (world[:, :320], world[:, 12:332])
    return StereoPair(*(np.uint8(np.clip(s + rng.normal(0, 1, s.shape), 0, 255)) for s in sides))


def test_a_plain_wall_below_a_textured_strip_is_warned_of_and_not_invented():
    pair = plain_wall(0.12)
    camera = stand_in_camera(320, 160, 32)
    given = recon.PairInput(pair, camera)
    found = recon.run_disparity(given, load_config(None, [], PAIR_DEFAULTS))
    ratios = found.disparity.reason_ratios
    assert ratios[Reason.VALID] < 0.25
    assert ratios.get(Reason.FILLED, 0.0) < 0.02
    assert found.summary.to_json()["valid_percent"] == pytest.approx(100 * ratios[Reason.VALID])
    (warning,) = (text for text in found.warnings if "of the pixels were measured" in text)
    assert "need more light, or texture" in warning


def real(data: Path) -> Iterator[tuple[str, StereoPair, object]]:
    for scene in sorted((data / "middlebury/MiddEval3/trainingQ").iterdir()):
        found = read_middlebury_scene(scene)
        yield scene.name, found.pair, found.camera
    for drive in ("driven/kitti_raw_0013", "driven/town_60", "rooms/euroc_v1_sparse"):
        source = open_source(data / drive)
        for index in (0, len(source) // 2):
            yield f"{drive} {index}", next(source.frames(index)), source.calibration
    source = open_source(data / "rendered/yard")
    yield "yard", next(source.frames()), source.calibration


@pytest.mark.real
@pytest.mark.slow
def test_no_good_pair_of_ours_is_warned_of_and_all_mixed_ones_are_refused(recon_data):
    config = load_config(None, ["mesh.depth=5"], PAIR_DEFAULTS)
    pairs = list(real(recon_data))
    for name, pair, camera in pairs:
        warnings = recon.run_disparity(recon.PairInput(pair, camera), config).warnings
        told = [text for text in warnings if "belong" in text or "features match" in text]
        assert told == [], name
    for (name, pair, _), (other, wrong, _) in itertools.pairwise(pairs):
        rows, columns = np.minimum(pair.left.shape[:2], wrong.left.shape[:2])
        sides = [np.ascontiguousarray(p[:rows, :columns]) for p in (pair.left, wrong.right)]
        if sides[0].ndim != sides[1].ndim:
            sides = [s if s.ndim == 2 else cv2.cvtColor(s, cv2.COLOR_RGB2GRAY) for s in sides]
        if "driven" in name and name.split()[0] == other.split()[0]:
            continue  # one street: what stands far away is in both
        with pytest.raises(MatchingError, match="nothing shows"):
            recon.run_disparity(recon.PairInput(StereoPair(*sides), stand_in_camera(columns, rows)))
