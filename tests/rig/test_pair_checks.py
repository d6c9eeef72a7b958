"""One pair: inputs that give no cloud, or one of the wrong scale, are reported."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from recon.commands.config import PAIR_DEFAULTS, load_config
from recon.commands.export import run_mesh
from recon.commands.pair import run_disparity, run_pair
from recon.core.errors import FormatError, MappingError, MatchingError, SettingsError
from recon.core.geometry.se3 import make_transform
from recon.core.progress import Silent, showing
from recon.core.values import (
    CameraIntrinsics,
    Disparity,
    Reason,
    RectifiedCamera,
    StereoCalibration,
    StereoPair,
)
from recon.export.pair import check_coverage
from recon.rig.audit import check_found
from recon.sources.one_pair import PairInput
from recon.stereo.observe import Support

pytestmark = pytest.mark.usefixtures("blank_figures")

CAMERA = RectifiedCamera(300.0, 160.0, 120.0, 160.0, 0.1, 320, 240)
SETTINGS = load_config(None, ["mesh.depth=5"], PAIR_DEFAULTS)


@pytest.fixture(scope="module")
def pair():
    """Blurred noise, 12 pixels further left in the right image."""
    world = np.random.default_rng(3).integers(0, 256, (240, 340)).astype(np.uint8)
    world = cv2.normalize(cv2.GaussianBlur(world, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    world = np.asarray(world, np.uint8)
    return StereoPair(world[:, :320], world[:, 12:332], name="left.png")


def run(pair, out, camera=CAMERA, command="disparity"):
    run_command = run_pair if command == "pair" else run_disparity
    return run_command(PairInput(pair, camera), SETTINGS, out=out)


@pytest.fixture(scope="module")
def good_run(pair, tmp_path_factory):
    """A run of the pair with a mesh, its folder, and the stages that it told of."""
    progress, out, told = Silent(), tmp_path_factory.mktemp("pair") / "run", []
    progress.on_stage = told.append
    given = PairInput(pair, CAMERA)
    with showing(progress):
        return run_pair(given, SETTINGS, out=out, formats=("glb",)), out, told


def test_images_that_show_nothing_no_point_or_two_things_are_told(pair, tmp_path):
    assert run(pair, tmp_path / "good").warnings == ()
    dark = replace(pair, right=np.zeros_like(pair.right))
    with pytest.raises(MatchingError, match=r"^left\.png: no pixel .* right camera shows nothing"):
        run(dark, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    settings = load_config(None, ["cloud.max_range_m=1"], PAIR_DEFAULTS)
    # 300 px and 0.1 m at 12 px: 2.5 m.
    with pytest.raises(MappingError, match=r"the cloud is empty .* at 2\.\d+ to 2\.5 m.* to 1 m"):
        run_pair(PairInput(pair, CAMERA), settings, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    other = replace(pair, right=np.ascontiguousarray(pair.right[::-1]))
    with pytest.raises(MatchingError, match=r"^left\.png: nothing shows that left and right"):
        run(other, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_same_image_twice_is_refused_as_such(pair, tmp_path):
    matrix = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    left = CameraIntrinsics(matrix, np.zeros(0), 320, 240)
    # Rectified, the image of such a right camera lies farther right: as if they were swapped.
    right = replace(left, matrix=matrix - [[0, 0, 40], [0, 0, 0], [0, 0, 0]])
    beside = make_transform(np.eye(3), np.array([-0.1, 0.0, 0.0]))
    for rig in (CAMERA, StereoCalibration(left, right, beside)):
        given = PairInput(replace(pair, right=pair.left), rig)
        with pytest.raises(MatchingError, match=r"^left\.png: left and right are the same image"):
            run_disparity(given, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("camera", "word"),
    [
        (replace(CAMERA, baseline_m=100.0), "baseline is unusual: 100 m"),
        (replace(CAMERA, cx_px=310.0, cx_right_px=310.0), "calibration is of another size"),
    ],
)
def test_a_calibration_that_gives_a_cloud_of_wrong_size_is_warned_of(pair, tmp_path, camera, word):
    run_ = run(pair, tmp_path / "pair", camera, "pair")
    assert any(word in line for line in run_.warnings)
    assert run_.summary.to_json()["warnings"] == list(run_.warnings)
    # Nobody asked for depth here.
    assert run(pair, tmp_path / "disparity", camera).warnings == ()


def test_the_run_of_a_pair_is_meshed_again_as_the_pair_was(good_run, tmp_path):
    first, folder, stages = good_run
    told = list(dict.fromkeys(stages))  # as they begin
    assert told == ["audit", "match", "mesh", "write", "report", "hash"]
    # One plane: all but a rim of two pixels.
    assert 0.95 < first.summary.to_json()["mesh_coverage"] <= 1
    assert not [text for text in first.warnings if "mesh" in text]
    assert check_coverage(0.8) == ()
    (warning,) = check_coverage(0.003)
    assert "covers 0.3 % of the cloud (points within 0.5 % of their depth)" in warning
    assert (folder / "mesh" / "mesh.glb").is_file()
    again = run_mesh(folder, SETTINGS, out=tmp_path / "again", formats=("glb", "obj")).to_json()
    assert again["mesh_coverage"] == pytest.approx(
        first.summary.to_json()["mesh_coverage"], abs=1e-3
    )
    for name in ("mesh.ply", "mesh.glb"):
        files = [run / "mesh" / name for run in (folder, tmp_path / "again")]
        assert files[0].read_bytes() == files[1].read_bytes()
    project = (tmp_path / "again" / "mesh" / "mesh.mlp").read_text()
    assert "0 -1 0 0" in project  # camera axes, turned upright


def test_a_run_without_a_camera_and_an_unknown_format_are_refused_before_the_work(tmp_path, pair):
    (tmp_path / "run.json").write_text('{"command": "pair"}')
    (tmp_path / "summary.json").write_text('{"focal_px": null}')
    with pytest.raises(FormatError, match="does not describe its camera"):
        run_mesh(tmp_path, load_config(), out=tmp_path / "out")
    with pytest.raises(SettingsError, match=r"--format: unknown mesh format .*fbx"):
        run_pair(PairInput(pair, CAMERA), out=tmp_path / "run", formats=("fbx",))
    assert not (tmp_path / "run").exists()


def kinds(measured: int, inferred: int) -> Disparity:
    """A hundred pixels, so many of them measured and inferred."""
    reason = np.full((1, 100), Reason.LOW_TEXTURE, np.uint8)
    reason[0, :measured], reason[0, measured : measured + inferred] = Reason.VALID, Reason.FILLED
    has = np.isin(reason, (Reason.VALID, Reason.FILLED))
    values = np.where(has, np.float32(9), np.float32(np.nan))
    return Disparity(values, has.astype(np.float32), values, reason)


@pytest.mark.parametrize(
    ("disparity", "words"),
    [
        (
            kinds(4, 35),
            "only 4 % of the pixels were measured (61 % low texture, 35 % inferred from ",
        ),
        (
            kinds(30, 50),
            "only 30 % of the pixels were measured (50 % inferred from planes around, ",
        ),
        (kinds(20, 0), "only 20 % of the pixels were measured (80 % low texture); "),
    ],
)
def test_a_pair_of_which_little_was_measured_says_what_to_do(disparity, words):
    assert check_found(disparity, "a", None)[0].startswith(words)
    belongs = Support(0.5, 0.0, 100, 90)
    (warning,) = check_found(disparity, "a", belongs)
    assert "plain or dark surfaces need more light, or texture" in warning


def test_a_pair_that_was_measured_is_not_warned_of_and_one_inferred_alone_is_refused():
    assert check_found(kinds(60, 30), "a", None) == ()
    assert check_found(kinds(25, 25), "a", None) == ()
    for nothing in (kinds(0, 90), kinds(0, 0)):
        with pytest.raises(MatchingError, match="no pixel has a match"):
            check_found(nothing, "a", None)
