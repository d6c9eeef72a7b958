"""The ONNX matcher with a tiny network built in the test."""

from pathlib import Path

import numpy as np
import pytest

from recon.core import errors
from recon.core.errors import FormatError, MatchingError, MissingDependencyError, SettingsError
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.io.middlebury import stand_in_camera
from recon.stereo.match.onnx import OnnxMatcher, OnnxSettings

onnx = pytest.importorskip("onnx", reason="the package onnx builds the network: pip install onnx")
pytest.importorskip("onnxruntime", reason="extra onnx: pip install 'recon[onnx]'")


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
    half = match(difference, pair_of(18, 10), std=(1 / 255,), width_px=30, height_px=20)
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
    for values in ({"width_px": 8}, {"mean": (0.1, 0.2)}, {"std": (0.0,)}):
        with pytest.raises(SettingsError):
            OnnxSettings.parse(values)
    with pytest.raises(SettingsError, match=r"matching\.onnx\.model"):
        OnnxMatcher(OnnxSettings()).match(pair_of(1, 2))


def test_without_the_extra_pip_is_named(difference, monkeypatch):
    def absent(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(errors, "import_module", absent)
    with pytest.raises(MissingDependencyError, match=r"recon\[onnx\]"):
        match(difference, pair_of(1, 2))
