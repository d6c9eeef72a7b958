"""The ONNX matcher with a tiny network built in the test."""

import signal
import threading
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import FormatError, MatchingError, SettingsError
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.io.middlebury import stand_in_camera
from recon.stereo.match import onnx as onnx_file
from recon.stereo.match.network import match_in_tiles, rendered_pair
from recon.stereo.match.onnx import PRESETS, OnnxMatcher, OnnxSettings, describe_network
from tests.stereo.match.networks import Graph, write_matcher

onnx = pytest.importorskip("onnx", reason="the package onnx builds the network: pip install onnx")
pytest.importorskip("onnxruntime", reason="extra onnx: pip install 'recon-stereo[onnx]'")


def write_network(path, inputs, nodes, shape=(1, 1, None, None)):
    """A network of simple nodes, (inputs, output, operator), with inputs of a declared shape."""
    helper, number = onnx.helper, onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        [helper.make_node(kind, given, [made]) for given, made, kind in nodes],
        "tiny",
        [helper.make_tensor_value_info(name, number, shape) for name in inputs],
        [helper.make_tensor_value_info(nodes[-1][1], number, None)],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(path))
    return path


@pytest.fixture
def difference(tmp_path):
    """Gives ``left - right``: a "disparity" that a test can predict."""
    sides = ["left", "right"]
    return write_network(tmp_path / "net.onnx", sides, [(sides, "d", "Sub")])


def pair_of(left: int, right: int, shape: tuple[int, int] = (40, 60)) -> RectifiedPair:
    images = (np.full(shape, level, np.uint8) for level in (left, right))
    return RectifiedPair(*images, stand_in_camera(shape[1], shape[0]))


def match(model: Path, pair: RectifiedPair, **settings: object) -> Disparity:
    """Match as a network that need not be a matcher, from the left view alone."""
    settings = {"self_test": False, "left_right": False, **settings}
    return OnnxMatcher(OnnxSettings(model=model, **settings), threads=1).match(pair)


def test_the_network_decides_the_disparity(difference):
    disparity = match(difference, pair_of(30, 10), std=(1 / 255,))
    assert disparity.values.shape == (40, 60)
    assert np.nanmin(disparity.values) == pytest.approx(20, abs=1e-3)
    assert np.nanmax(disparity.values) == pytest.approx(20, abs=1e-3)
    # Left of column 20 the match lies beside the right image.
    assert (disparity.reason[:, :19] == Reason.BORDER).all()
    assert disparity.valid[:, 21:].all()
    scaled = match(difference, pair_of(10, 15), mean=(0.2,), std=(0.5 / 255,), output_scale=-1.0)
    assert np.nanmedian(scaled.values) == pytest.approx(10, abs=1e-3)
    # 8 pixels of an image half as wide are 16 of the image.
    half = match(difference, pair_of(18, 10), std=(1 / 255,), size_px=(30, 20))
    assert np.nanmedian(half.values) == pytest.approx(16)


def write_mean(path: Path, inputs: list[str], shape: tuple[int | None, ...]) -> Path:
    """A network that gives the mean over the channels of its input, or of the difference of two."""
    nodes = [(inputs, "x", "Sub")] if len(inputs) == 2 else []
    write_network(path, inputs, [*nodes, (["x"] if nodes else inputs, "d", "ReduceMean")], shape)
    model, make = onnx.load(str(path)), onnx.helper.make_attribute
    model.graph.node[-1].attribute.extend([make("axes", [1]), make("keepdims", 1)])
    onnx.save(model, str(path))
    return path


def test_inputs_are_those_that_the_network_declares_and_what_is_not_finite_no_match(tmp_path):
    path = write_mean(tmp_path / "one.onnx", ["both"], (1, None, None, None))
    stacked = match(path, pair_of(4, 8), std=(1 / 255,))
    assert np.nanmedian(stacked.values) == pytest.approx(6, abs=1e-3)
    path = write_mean(tmp_path / "fixed.onnx", ["left", "right"], (1, 3, 20, 30))
    fixed = match(path, pair_of(18, 10), mean=(0.1, 0.1, 0.1), std=(1 / 255,))
    assert np.nanmedian(fixed.values) == pytest.approx(16)
    nodes = [(["left", "right"], "x", "Sub"), (["x"], "d", "Log")]
    path = write_network(tmp_path / "log.onnx", ["left", "right"], nodes)
    assert (match(path, pair_of(10, 30)).reason == Reason.AMBIGUOUS).all()


def test_no_map_and_other_inputs_of_a_network_are_refused(difference, tmp_path):
    sides, letters = ["left", "right"], ["a", "b", "c"]
    shape = (1, 3, None, None)
    colours = write_network(tmp_path / "colours.onnx", sides, [(sides, "d", "Sub")], shape)
    none = Graph()
    none.write(tmp_path / "none.onnx", {}, none.add("Add", none.constant(1.0), none.constant(2.0)))
    with pytest.raises(FormatError, match="no input"):
        match(tmp_path / "none.onnx", pair_of(1, 2))
    three = write_network(tmp_path / "three.onnx", letters, [(letters, "d", "Sum")])
    for path, settings, words in (
        (colours, {}, "not a disparity map"),
        (three, {}, "number of inputs"),
        (difference, {"output": 3}, "no such output"),
    ):
        with pytest.raises(MatchingError, match=words):
            match(path, pair_of(1, 2), **settings)
    with pytest.raises(SettingsError, match="more numbers than the network has channels"):
        match(difference, pair_of(1, 2), mean=(0.1, 0.2, 0.3))


def test_a_file_that_is_no_network_and_settings_that_disagree_are_refused(tmp_path):
    (tmp_path / "bad.onnx").write_bytes(b"no network")
    for name, words in (("bad.onnx", r"bad\.onnx"), ("none.onnx", "does not exist")):
        with pytest.raises(FormatError, match=words):
            match(tmp_path / name, pair_of(1, 2))
    for values in ({"size_px": (8,)}, {"mean": (0.1, 0.2)}, {"std": (0.0,)}):
        with pytest.raises(SettingsError):
            OnnxSettings.parse(values)
    with pytest.raises(SettingsError, match=r"matching\.onnx\.model"):
        OnnxMatcher(OnnxSettings()).match(pair_of(1, 2))


@pytest.fixture(scope="module")
def matcher_file(tmp_path_factory):
    """A network that matches, of two inputs of one channel."""
    return write_matcher(tmp_path_factory.mktemp("network") / "sad.onnx")


def plane_pair(*, hide: bool = False) -> tuple[RectifiedPair, np.ndarray]:
    """A textured plane with its disparity; with a square before it, 8 px nearer, if ``hide``."""
    left, right, truth = (np.array(one) for one in rendered_pair((320, 160)))
    if hide:
        left, truth = left.copy(), truth.copy()
        square = np.random.default_rng(1).integers(40, 215, (60, 60), dtype=np.uint8)
        left[50:110, 150:210], right[50:110, 130:190], truth[50:110, 150:210] = square, square, 20
    return RectifiedPair(left, right, stand_in_camera(320, 160)), truth


def run(model: Path, pair: RectifiedPair, **settings: object) -> Disparity:
    return OnnxMatcher(OnnxSettings(model=model, **settings), threads=1).match(pair)


def test_agreement_of_both_views_finds_what_one_hides_and_rates_the_rest(matcher_file):
    pair, truth = plane_pair(hide=True)
    found = run(matcher_file, pair)
    error = np.abs(found.values - truth)[found.valid]
    assert np.median(error) < 0.3
    # The plane is 14 px behind the square at most, and as much of it is seen by the left view only.
    shadow = found.reason[60:100, 144:149]
    assert np.isin(shadow, (Reason.OCCLUDED, Reason.LEFT_RIGHT)).mean() > 0.9
    sure, sigma = found.confidence[found.valid], found.sigma_px[found.valid]
    least, most = np.quantile(sure, (0.1, 0.9))
    assert (error[sure < least] > 1).mean() > (error[sure >= most] > 1).mean()
    assert np.abs(sure.mean() - (error <= 1).mean()) < 0.1
    assert 0.25 <= sigma.min() < sigma.max() < 3
    assert 0.6 < (error <= sigma).mean() <= 1
    alone = run(matcher_file, pair, left_right=False)
    assert alone.valid.sum() > found.valid.sum()
    assert len(np.unique(alone.confidence[alone.valid])) == 1


def scaled(factor):
    return lambda graph, name: graph.add("Mul", name, graph.constant(factor))


def invalid(graph, name):
    return graph.add("Div", graph.add("Sub", name, name), graph.constant(0.0))


def everywhere(graph, name):
    return graph.add("Add", graph.add("Sub", name, name), graph.constant(7.0))


@pytest.mark.parametrize(
    ("last", "settings", "words"),
    [
        (scaled(-1.0), {}, r"-1\.?\d* times the disparity.*output_scale=-1"),
        (scaled(0.5), {}, r"0\.5\d* times the disparity.*output_scale=(1\.9|2)"),
        (scaled(1.0), {"output_scale": -2.0}, r"-2.*output_scale=(0\.99|1)"),
        (invalid, {}, "no finite number"),
        (everywhere, {}, "7 everywhere"),
        (scaled(1.0), {"std": (100.0,)}, "median error|everywhere"),
    ],
)
def test_a_network_that_does_not_find_a_rendered_plane_is_refused(tmp_path, last, settings, words):
    path = write_matcher(tmp_path / "n.onnx", last=last)
    with pytest.raises(MatchingError, match=words):
        run(path, plane_pair()[0], **settings)


@pytest.mark.parametrize(
    ("preset", "made"),
    [
        # As converted from TensorFlow: channels at the end of the output.
        ("hitnet", {"stacked": True, "size": (128, 320), "last": "transpose"}),
        ("lite-any-stereo", {"channels": 3, "size": (160, 320), "last": "levels"}),
    ],
)
def test_a_network_laid_out_like_that_of_a_preset_is_fed_as_it_is_meant(tmp_path, preset, made):
    def transpose(graph, name):
        return graph.add("Transpose", name, perm=[0, 2, 3, 1])

    last = transpose if made["last"] == "transpose" else None
    path = write_matcher(tmp_path / "n.onnx", **{**made, "last": last})
    pair, truth = plane_pair()
    found = run(path, pair, preset=preset)
    assert np.nanmedian(np.abs(found.values - truth)) < 0.5
    about = describe_network(OnnxSettings(model=path, preset=preset)).to_json()
    assert about["trained_on"] == PRESETS[preset].trained_on
    assert len(about["sha256"]) == 64
    other = {"hitnet": "lite-any-stereo", "lite-any-stereo": "hitnet"}[preset]
    with pytest.raises(SettingsError, match=r"not the network of the preset.*get "):
        run(path, pair, preset=other)


def test_a_preset_without_a_file_says_which_to_get_and_what_is_set_wins():
    with pytest.raises(SettingsError, match="stereodemo"):
        OnnxMatcher(OnnxSettings(preset="hitnet")).match(pair_of(1, 2))
    own = OnnxSettings(preset="lite-any-stereo", std=(0.5,), output_scale=2.0).read()
    assert (own.std, own.output_scale, own.mean) == ((0.5,), 2.0, (0.0,))
    assert OnnxSettings(preset="lite-any-stereo").read().std == (1 / 255,)


def test_colours_reach_a_network_of_three_channels(tmp_path):
    def write_green(path):
        graph = Graph()
        return graph.write(
            path,
            dict.fromkeys(("left", "right"), (1, 3, None, None)),
            graph.cut("left", 1, 1, 2),
        )

    pair, colour = pair_of(0, 0), np.zeros((40, 60, 3), np.uint8)
    colour[..., 1] = 12
    seen = RectifiedPair(pair.left, pair.right, pair.camera, left_rgb=colour, right_rgb=colour)
    values = match(write_green(tmp_path / "g.onnx"), seen, std=(1 / 255,)).values
    assert np.nanmedian(values) == pytest.approx(12)


@pytest.mark.parametrize("shape", [(448, 320), (128, 1024), (384, 512)])
def test_tiles_give_what_the_whole_image_gives(matcher_file, shape, monkeypatch):
    random = np.random.default_rng(3)
    right = random.integers(0, 255, shape, dtype=np.uint8)
    pair = RectifiedPair(np.roll(right, 9, 1), right, stand_in_camera(*shape[::-1], ndisp=24))
    whole = run(matcher_file, pair, self_test=False, left_right=False)
    monkeypatch.setattr(onnx_file, "_TILE_PX", 100_000)
    tiled = run(matcher_file, pair, self_test=False, left_right=False)
    np.testing.assert_allclose(tiled.values, whole.values, atol=1e-4)
    assert np.nanmedian(tiled.values) == pytest.approx(9, abs=0.1)


def test_no_tile_of_a_huge_image_is_larger_than_allowed():
    sizes = []

    def look(left, right):
        sizes.append(left.size)
        return left.astype(np.float32)

    image = np.tile(np.arange(250, dtype=np.uint8), (2016, 40))[:, :9984]
    found = match_in_tiles(look, (image, image), 500, 1_000_000, 32)
    np.testing.assert_array_equal(found, image)
    assert 500_000 < max(sizes) <= 1_000_000
    assert len(sizes) < 80


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"<!DOCTYPE html><html>", "a web page"),
        (b"\n\n  <html>", "a web page"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0", "git-lfs"),
        (b"PK\x03\x04archive/data.pkl", "PyTorch"),
        (b"\x1f\x8b\x08", "gzip"),
        (b"", "onnxruntime cannot load"),
    ],
)
def test_what_is_saved_instead_of_a_network_is_named(tmp_path, content, words):
    (tmp_path / "n.onnx").write_bytes(content)
    with pytest.raises(FormatError, match=words):
        match(tmp_path / "n.onnx", pair_of(1, 2))


@pytest.mark.parametrize("shape", [
    (1, 1, 100_000, 100_000), (1, 3, 0, 0), (1, 1, None, 1 << 40), (1, 1 << 30, None, None),
])  # fmt: skip
@pytest.mark.parametrize("self_test", [True, False])
def test_a_network_of_images_that_there_are_not_is_refused(tmp_path, shape, self_test):
    sides = ["left", "right"]
    path = write_network(tmp_path / "odd.onnx", sides, [(sides, "d", "Sub")], shape)
    with pytest.raises(FormatError, match=r"odd.onnx: the network does not take images \(got 1x"):
        match(path, pair_of(1, 2), self_test=self_test)


def test_an_output_without_a_pixel_is_refused(tmp_path):
    graph = Graph()
    shapes = dict.fromkeys(("left", "right"), (1, 1, None, None))
    path = graph.write(tmp_path / "none.onnx", shapes, graph.cut("left", 2, 0, 0))
    with pytest.raises(MatchingError, match="not a disparity map"):
        match(path, pair_of(1, 2))


def write_loop(path):
    """A network that adds one to the left image for ever."""
    helper, types = onnx.helper, onnx.TensorProto
    value = helper.make_tensor_value_info
    node = helper.make_node
    body = helper.make_graph(
        [node("Identity", ["on"], ["still"]), node("Add", ["x", "one"], ["y"])],
        "body",
        [value("n", types.INT64, []), value("on", types.BOOL, []), value("x", types.FLOAT, None)],
        [value("still", types.BOOL, []), value("y", types.FLOAT, None)],
    )  # fmt: skip
    graph = Graph()
    graph.constants.append(onnx.numpy_helper.from_array(np.float32(1), "one"))
    on = graph.constant(True, np.bool_)
    looped = graph.add("Loop", "", on, "left", body=body)
    return graph.write(path, dict.fromkeys(("left", "right"), (1, 1, None, None)), looped)


@pytest.mark.parametrize("self_test", [True, False])
def test_a_network_without_an_end_is_ended(tmp_path, self_test, monkeypatch):
    monkeypatch.setattr(onnx_file, "_TIME_LIMIT_S", 0.3)
    path = write_loop(tmp_path / "loop.onnx")
    with pytest.raises(MatchingError, match=r"does not come to an end.*0.3 s.*smaller images"):
        match(path, pair_of(1, 2), self_test=self_test)


def test_ctrl_c_ends_a_network(tmp_path):
    path = write_loop(tmp_path / "loop.onnx")
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # perhaps ignored
    main = threading.main_thread().ident
    threading.Timer(0.5, signal.pthread_kill, (main, signal.SIGINT)).start()
    try:
        with pytest.raises(KeyboardInterrupt):
            match(path, pair_of(1, 2))
    finally:
        signal.signal(signal.SIGINT, before)
