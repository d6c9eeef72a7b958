from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import FormatError
from recon.core.values.camera import depth_from_disparity
from recon.evaluation.middlebury.bench import find_scenes, read_scored_scene
from recon.io import middlebury
from recon.io.images.disparity import write_pfm
from recon.io.images.image import write_image

CALIB = """cam0=[999.421 0 294.182; 0 999.421 252.932; 0 0 1]
cam1=[999.421 0 326.96; 0 999.421 252.932; 0 0 1]
doffs=32.778
baseline=193.001
width=24
height=12
ndisp=70
isint=0
vmin=5
vmax=60
"""
NAN = float("nan")


def image(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (height, width, 3), dtype=np.uint8)


def make_2014(folder: Path) -> Path:
    for name in ("im0.png", "im1.png"):
        write_image(folder / name, image(12, 24))
    (folder / "calib.txt").write_text(CALIB)
    return folder


def test_calib_txt_gives_metres_and_doffs(tmp_path):
    calib = middlebury.read_middlebury_calib(make_2014(tmp_path) / "calib.txt")
    assert calib.camera.baseline_m == pytest.approx(0.193001)
    assert calib.camera.doffs_px == pytest.approx(32.778)
    assert (calib.camera.ndisp, calib.isint) == (70, False)
    # Z = baseline·f/(d + doffs), with the numbers of the file.
    depth = depth_from_disparity(np.array([10.0]), calib.camera)
    assert depth[0] == pytest.approx(0.193001 * 999.421 / 42.778, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "size", "factor"),
    [
        ("trainingQ/any", (24, 12), 4), ("trainingH/any", (24, 12), 2), ("testF/any", (24, 12), 1),
        ("Piano", (705, 480), 4), ("Piano", (1410, 960), 2), ("Piano", (2820, 1920), 1),
        ("ArtL", (347, 277), 4), ("ArtL", (694, 554), 2), ("ArtL", (1388, 1108), 1),
        ("Teddy", (450, 375), 4), ("Teddy", (1800, 1500), 1), ("Jadeplant", (658, 497), 4),
        ("Adirondack-perfect", (2880, 1988), 1), ("artroom1", (1920, 1080), 1),
        ("mine", (640, 480), 1),
    ],
)  # fmt: skip
def test_full_size_factor_follows_the_collection_or_the_name_of_the_scene(name, size, factor):
    layout = middlebury.Layout("im0", "im1", "disp0", "disp1", calibrated=True)
    assert middlebury.units_of(layout, *size, Path("anywhere") / name).factor == factor


def test_truth_in_pfm_makes_a_scene_without_its_calibration(tmp_path):
    folder = make_2014(tmp_path / "Adirondack-perfect")
    (folder / "calib.txt").unlink()
    write_pfm(folder / "disp0.pfm", np.full((12, 24), 4.0, np.float32))
    scene = middlebury.read_middlebury_scene(folder)
    assert (scene.camera, scene.ndisp) == (None, None)
    assert scene.truth is not None


@pytest.mark.parametrize("inside", ["", "Illum1/Exp2"])
def test_truth_and_dmin_of_2005_may_lie_above_folders_of_light_and_exposure(tmp_path, inside):
    root, name = tmp_path / "Aloe", f"Aloe/{inside}".rstrip("/")
    for view in ("view1.png", "view5.png"):
        write_image(root / inside / view, image(370, 463))
    write_image(root / "disp1.png", np.full((370, 463), 9, np.uint8))
    (root / "dmin.txt").write_text("150\n")
    scene = middlebury.read_middlebury_scene(root / inside)
    assert (scene.truth.values == 3).all()
    assert scene.camera == middlebury.nominal_camera_2005(463, 370, 150, 3)
    assert scene.camera.focal_px == pytest.approx(3740 / 3)
    assert (scene.camera.doffs_px, scene.camera.baseline_m) == (pytest.approx(50), 0.16)
    assert list(find_scenes(tmp_path)) == [name]
    assert read_scored_scene(name, root / inside, None) is not None


def test_eval3_truth_has_nan_for_inf_and_the_mask_of_its_file(tmp_path):
    folder = make_2014(tmp_path)
    values = np.full((12, 24), 5.0, dtype=np.float32)
    values[0, 0] = NAN
    write_pfm(folder / "disp0GT.pfm", values)
    mask = np.full((12, 24), 255, dtype=np.uint8)
    mask[1, 1], mask[2, 2] = 128, 0
    write_image(folder / "mask0nocc.png", mask)
    truth = middlebury.read_middlebury_scene(folder).truth
    np.testing.assert_array_equal(truth.values, values)
    assert {tuple(at) for at in np.argwhere(~truth.nonocc)} == {(0, 0), (1, 1), (2, 2)}


def test_truth_of_2014_without_a_mask_is_cross_checked(tmp_path):
    folder = make_2014(tmp_path)
    left = np.full((12, 24), 4.0, dtype=np.float32)
    right = left.copy()
    right[:, 10] = 9.0
    write_pfm(folder / "disp0.pfm", left)
    write_pfm(folder / "disp1.pfm", right)
    truth = middlebury.read_middlebury_scene(folder).truth
    hidden = [0, 1, 2, 3, 14]  # out of the right view, and where the right truth is another
    np.testing.assert_array_equal(np.flatnonzero(~truth.nonocc[5]), hidden)


@pytest.mark.parametrize(
    ("names", "size", "scale", "generation"),
    [
        ("im3.png im4.png disp3.pgm", (288, 384), 16, "2001"),
        ("scene1.row3.col3.ppm scene1.row3.col4.ppm truedisp.row3.col3.pgm", (8, 384), 16, "2001"),
        ("im2.ppm im6.ppm disp2.pgm", (383, 434), 8, "2001"),
        ("im0.png im1.png disp0.pgm", (216, 284), 8, "2001"),
        ("im2.png im6.png disp2.png", (375, 450), 4, "2003"),
        ("im2.png im6.png disp2.png", (750, 900), 2, "2003"),
        ("view1.png view5.png disp1.png", (370, 463), 3, "2005"),
        ("view1.png view5.png disp1.png", (555, 695), 2, "2005"),
    ],
)
def test_older_scenes_are_distinguished_and_their_truth_scaled(
    tmp_path, names, size, scale, generation
):
    left, right, truth = names.split()
    for name in (left, right):
        write_image(tmp_path / name, image(*size))
    write_image(tmp_path / truth, np.tile(np.arange(size[1]) % 200, (size[0], 1)).astype(np.uint8))
    scene = middlebury.read_middlebury_scene(tmp_path)
    assert (scene.generation, scene.camera) == (generation, None)
    assert scene.full_size_factor == (1 if generation == "2001" else scale)
    np.testing.assert_allclose(scene.truth.values[0, :3], [NAN, 1 / scale, 2 / scale], rtol=1e-6)


def test_images_that_are_missing_or_of_another_size_are_named(tmp_path):
    folder = make_2014(tmp_path)
    write_pfm(folder / "disp0.pfm", np.ones((12, 23), dtype=np.float32))
    with pytest.raises(FormatError, match=r"disp0\.pfm: size.*got 23x12, expected 24x12"):
        middlebury.read_middlebury_scene(folder)
    write_image(folder / "im1.png", image(12, 23))
    with pytest.raises(FormatError, match=r"differ in size \(got im0 24x12, im1 23x12\)"):
        middlebury.read_middlebury_scene(folder)
    (folder / "im1.png").unlink()
    with pytest.raises(FormatError, match=r"image is missing \(expected im1.png\)"):
        middlebury.read_middlebury_scene(folder)


@pytest.mark.real
@pytest.mark.parametrize(
    ("scene", "generation", "shape", "highest_px"),
    [
        ("2001/Tsukuba", "2001", (288, 384), 16),
        ("2003/Cones", "2003", (375, 450), 60),
        ("2005/Art", "2005", (370, 463), 85),
        ("2006/Aloe", "2005", (370, 427), 85),
        ("MiddEval3/trainingQ/Jadeplant", "2014", (497, 659), 160),
        ("MiddEval3/trainingQ/Pipes", "2014", (485, 735), 75),
    ],
)
def test_real_truth_lies_within_what_is_promised(recon_data, scene, generation, shape, highest_px):
    read = middlebury.read_middlebury_scene(recon_data / "middlebury" / scene)
    assert (read.generation, read.pair.left.shape[:2]) == (generation, shape)
    known = np.isfinite(read.truth.values)
    assert known.mean() > 0.75
    assert 0 < read.truth.values[known].min() < read.truth.values[known].max() < highest_px
    assert 0.7 < read.truth.nonocc[known].mean() < 1
    if read.camera is not None and read.camera.ndisp is not None:
        assert read.camera.ndisp == highest_px
