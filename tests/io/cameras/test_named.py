"""Calibrations of other programs: what each writes of a rig is read back as that rig."""

import io
import json
import os
import pickle
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import loadmat, savemat

from recon.core.errors import CalibrationError, FormatError, ReconError
from recon.core.geometry.se3 import (
    exp_so3,
    invert,
    log_so3,
    make_transform,
    quaternion_from_rotation,
)
from recon.core.values import CameraIntrinsics, LensModel, RectifiedCamera, StereoCalibration
from recon.io.cameras.calibration import read_calibration, write_recon_calibration
from recon.sources.calibration import find_calibration

SIZE = (1280, 720)


@st.composite
def rigs(draw, lens: LensModel = "pinhole", count: int = 5) -> StereoCalibration:
    def camera() -> CameraIntrinsics:
        f, cx, cy = draw(st.floats(500, 900)), draw(st.floats(560, 720)), draw(st.floats(320, 400))
        matrix = np.array([[f, 0, cx], [0, f * draw(st.floats(0.98, 1.02)), cy], [0, 0, 1]])
        terms = {"ds": (-0.2, 0.6), "eucm": (0.6, 1.1), "fov": (0.9,), "omni": (1.2, 0.1, 0, 0, 0)}
        drawn = [draw(st.floats(-0.2, 0.2)) for _ in range(count)]
        return CameraIntrinsics(matrix, np.array(terms.get(lens, drawn), float), *SIZE, lens)

    turn = np.array([draw(st.floats(-0.1, 0.1)) for _ in range(3)])
    step = [-draw(st.floats(0.05, 0.5)), draw(st.floats(-0.01, 0.01)), draw(st.floats(-0.01, 0.01))]
    return StereoCalibration(camera(), camera(), make_transform(exp_so3(turn), np.array(step)))


def npz(path: Path, rig: StereoCalibration, **names: str) -> Path:
    path = path / "stereo_calib.npz"
    T = rig.T_right_left
    said = {"K1": "K1", "D1": "D1", "K2": "K2", "D2": "D2", "R": "R", "T": "T", **names}
    values = {"K1": rig.left.matrix, "D1": rig.left.distortion[None], "K2": rig.right.matrix,
              "D2": rig.right.distortion[None], "R": T[:3, :3], "T": T[:3, 3:]}  # fmt: skip
    maps = np.zeros((720, 1280), np.float32)
    np.savez_compressed(path, **{said[k]: v for k, v in values.items()}, map1x=maps, rms=0.3)
    return path


def zed(path: Path, rig: StereoCalibration) -> Path:
    lines = []
    for side, camera in (("LEFT", rig.left), ("RIGHT", rig.right)):
        for name, scale in (("2K", 2.0), ("HD", 1.0), ("VGA", 0.5)):
            K = camera.matrix * scale
            lens = zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=True)
            own = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], **dict(lens)}
            lines += [f"[{side}_CAM_{name}]", *(f"{k}={v:.17g}" for k, v in own.items()), ""]
    turn, step = log_so3(rig.T_right_left[:3, :3]), -1000 * rig.T_right_left[:3, 3]
    lines += [f"[{side}_DISTO]\nk1=9.5" for side in ("LEFT", "RIGHT")] + ["[STEREO]"]
    lines += [f"{k}={v:.17g}" for k, v in zip(("Baseline", "TY", "TZ"), step, strict=True)]
    turns = zip(("RX", "CV", "RZ"), turn, strict=True)
    lines += [f"{k}_{n}={v:.17g}" for k, v in turns for n in ("HD", "VGA")]
    (path / "SN123.conf").write_text("\n".join(lines))
    return path / "SN123.conf"


def _oak(path: Path, rig: StereoCalibration, T: np.ndarray, owner: int) -> Path:
    cameras = []
    for socket, camera in ((2, rig.left), (1, rig.right)):
        step = dict(zip("xyz", (100 * T[:3, 3]).tolist(), strict=True))
        own = {"rotationMatrix": T[:3, :3].tolist(), "translation": step,
               "specTranslation": {"x": 1, "y": 2, "z": 3},
               "toCameraSocket": 3 - socket if socket == owner else -1}  # fmt: skip
        lens = np.pad(camera.distortion, (0, 14 - camera.distortion.size)).tolist()
        kind = int(camera.model == "fisheye")
        cameras.append([socket, {"cameraType": kind, "distortionCoeff": lens, "extrinsics": own,
                                 "height": 720, "width": 1280,
                                 "intrinsicMatrix": camera.matrix.tolist()}])  # fmt: skip
    cameras.append([0, {"intrinsicMatrix": np.eye(3).tolist(), "width": 4056, "height": 3040}])
    sockets = {"leftCameraSocket": 2, "rightCameraSocket": 1}
    content = {"cameraData": cameras, "stereoRectificationData": sockets}
    (path / "oak_calib.json").write_text(json.dumps(content))
    return path / "oak_calib.json"


def oak(path: Path, rig: StereoCalibration) -> Path:
    return _oak(path, rig, rig.T_right_left, 2)


def oak_of_the_right(path: Path, rig: StereoCalibration) -> Path:
    return _oak(path, rig, invert(rig.T_right_left), 1)


def matlab(path: Path, rig: StereoCalibration) -> Path:
    def camera(one: CameraIntrinsics) -> dict[str, object]:
        K, D = one.matrix + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]]), one.distortion
        return {"IntrinsicMatrix": K.T, "RadialDistortion": D[[0, 1, 4]],
                "TangentialDistortion": D[2:4], "ImageSize": [720.0, 1280.0]}  # fmt: skip

    T = rig.T_right_left
    stereo = {"CameraParameters1": camera(rig.left), "CameraParameters2": camera(rig.right),
              "RotationOfCamera2": T[:3, :3].T, "TranslationOfCamera2": 1000 * T[:3, 3],
              "FundamentalMatrix": np.eye(3)}  # fmt: skip
    savemat(path / "stereo.mat", {"stereoParams": stereo}, do_compression=True)
    return path / "stereo.mat"


def bouguet(path: Path, rig: StereoCalibration) -> Path:
    values: dict[str, object] = {"om": log_so3(rig.T_right_left[:3, :3])[:, None], "nx": 1280.0,
                                 "T": 1000 * rig.T_right_left[:3, 3:], "ny": 720.0}  # fmt: skip
    for side, one in (("left", rig.left), ("right", rig.right)):
        K = one.matrix
        values |= {f"fc_{side}": K[[0, 1], [0, 1]], f"cc_{side}": K[:2, 2],
                   f"kc_{side}": one.distortion, f"om_{side}_1": np.ones(3)}  # fmt: skip
    savemat(path / "Calib_Results_stereo.mat", values)
    return path / "Calib_Results_stereo.mat"


def realsense(path: Path, rig: StereoCalibration) -> Path:
    def camera(one: CameraIntrinsics) -> dict[str, object]:
        K = one.matrix
        return {"width": 1280, "height": 720, "fx": K[0, 0], "fy": K[1, 1], "ppx": K[0, 2],
                "ppy": K[1, 2], "model": "distortion.brown_conrady",
                "coeffs": one.distortion.tolist()}  # fmt: skip

    T = rig.T_right_left
    step = {"rotation": T[:3, :3].T.ravel().tolist(), "translation": T[:3, 3].tolist()}
    content = {"infra1": camera(rig.left), "infra2": camera(rig.right),
               "extrinsics": {"infra1_to_infra2": step}}  # fmt: skip
    (path / "realsense.json").write_text(json.dumps(content))
    return path / "realsense.json"


def orb_slam_3(path: Path, rig: StereoCalibration) -> Path:
    lines = ["%YAML:1.0", 'Camera.type: "PinHole"', "Camera.width: 1280", "Camera.height: 720"]
    for number, one in ((1, rig.left), (2, rig.right)):
        K, lens = one.matrix, zip(("k1", "k2", "p1", "p2", "k3"), one.distortion, strict=True)
        own = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], **dict(lens)}
        lines += [f"Camera{number}.{k}: {v:.17g}" for k, v in own.items()]
    data = ", ".join(f"{v:.17g}" for v in invert(rig.T_right_left).ravel())
    lines += ["Stereo.T_c1_c2: !!opencv-matrix", "   rows: 4", "   cols: 4", "   dt: f",
              f"   data: [{data}]", "Viewer.PointSize:2"]  # fmt: skip
    (path / "settings.yaml").write_text("\n".join(lines))
    return path / "settings.yaml"


def orb_slam_2(path: Path, rig: StereoCalibration) -> Path:
    """Raw images, whose pose is in two rectifying rotations."""
    from tests.io.cameras.test_calibrations import write_ros

    left, right = write_ros(path / "x.yaml", rig)
    content = {"Camera.fx": 400.0, "Camera.fy": 400.0, "Camera.cx": 640.0, "Camera.cy": 360.0,
               "Camera.width": 1280, "Camera.height": 720, "Camera.bf": 40.0}  # fmt: skip
    names = {"K": "camera_matrix", "R": "rectification_matrix", "P": "projection_matrix",
             "D": "distortion_coefficients"}  # fmt: skip
    for side, one in (("LEFT", left), ("RIGHT", right)):
        read = yaml.safe_load(one.read_text())
        content |= {f"{side}.{k}": read[name] for k, name in names.items()}
        one.unlink()
    (path / "EuRoC.yaml").write_text("%YAML:1.0\n---\n" + yaml.safe_dump(content))
    return path / "EuRoC.yaml"


def _vins_camera(one: CameraIntrinsics) -> dict[str, object]:
    K, D = one.matrix.tolist(), one.distortion.tolist()
    size = {"camera_name": "c", "image_width": 1280, "image_height": 720}
    if one.model == "fisheye":
        own = {f"k{n + 2}": d for n, d in enumerate(D)}
        own |= {"mu": K[0][0], "mv": K[1][1], "u0": K[0][2], "v0": K[1][2]}
        return {"model_type": "KANNALA_BRANDT", **size, "projection_parameters": own}
    lens = dict(zip(("k1", "k2", "p1", "p2"), D[-4:], strict=True))
    if one.model == "omni":
        own = {"gamma1": K[0][0], "gamma2": K[1][1], "u0": K[0][2], "v0": K[1][2]}
        return {"model_type": "MEI", **size, "mirror_parameters": {"xi": D[0]},
                "distortion_parameters": lens, "projection_parameters": own}  # fmt: skip
    own = {"fx": K[0][0], "fy": K[1][1], "cx": K[0][2], "cy": K[1][2]}
    return {"model_type": "PINHOLE", **size, "distortion_parameters": lens,
            "projection_parameters": own}  # fmt: skip


BODY = make_transform(exp_so3(np.array([1.2, -0.7, 0.4])), np.array([0.3, -0.1, 0.2]))


def vins(path: Path, rig: StereoCalibration) -> Path:
    content: dict[str, object] = {"imu": 1, "cam0_calib": "a.yaml", "cam1_calib": "b.yaml"}
    for number, name, one, T in ((0, "a", rig.left, BODY),
                                 (1, "b", rig.right, BODY @ invert(rig.T_right_left))):  # fmt: skip
        content[f"body_T_cam{number}"] = {"rows": 4, "cols": 4, "data": T.ravel().tolist()}
        text = yaml.safe_dump(_vins_camera(one), sort_keys=False)
        (path / f"{name}.yaml").write_text("%YAML:1.0\n---\n" + text)
    (path / "config.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump(content, sort_keys=False))
    return path / "config.yaml"


def basalt(path: Path, rig: StereoCalibration) -> Path:
    poses, cameras = [], []
    for one, T in ((rig.left, BODY), (rig.right, BODY @ invert(rig.T_right_left))):
        quaternion = quaternion_from_rotation(T[:3, :3]).tolist()
        names = ("px", "py", "pz", "qx", "qy", "qz", "qw")
        poses.append(dict(zip(names, [*T[:3, 3].tolist(), *quaternion], strict=True)))
        K, D = one.matrix, one.distortion
        own = {
            "fx": K[0, 0],
            "fy": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
            "xi": D[0],
            "alpha": D[1],
        }
        cameras.append({"camera_type": "ds", "intrinsics": own})
    sizes = [list(SIZE), list(SIZE)]
    value = {"T_imu_cam": poses, "intrinsics": cameras, "resolution": sizes}
    (path / "calibration.json").write_text(json.dumps({"value0": value}))
    return path / "calibration.json"


def kalibr(path: Path, rig: StereoCalibration) -> Path:
    chain: dict[str, dict[str, object]] = {}
    names = {"ds": ("ds", "none"), "eucm": ("eucm", "none"), "fov": ("pinhole", "fov"),
             "omni": ("omni", "radtan"), "fisheye": ("pinhole", "equidistant")}  # fmt: skip
    for number, one in enumerate((rig.left, rig.right)):
        K, D, (model, lens) = one.matrix, one.distortion.tolist(), names[one.model]
        head = {"ds": 2, "eucm": 2, "omni": 1}.get(model, 0)
        pinhole = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
        chain[f"cam{number}"] = {
            "cam_overlaps": [1 - number], "camera_model": model, "distortion_model": lens,
            "distortion_coeffs": D[head:], "intrinsics": [*D[:head], *pinhole],
            "resolution": list(SIZE), "rostopic": "/x", "timeshift_cam_imu": 0.01,
            "T_cam_imu": (BODY if number == 0 else rig.T_right_left @ BODY).tolist(),
        }  # fmt: skip
    chain["cam1"]["T_cn_cnm1"] = rig.T_right_left.tolist()
    chain["cam2"] = {**chain["cam1"], "T_cn_cnm1": BODY.tolist()}
    (path / "camchain-x.yaml").write_text(yaml.safe_dump(chain))
    return path / "camchain-x.yaml"


def ours(path: Path, rig: StereoCalibration) -> Path:
    write_recon_calibration(path / "rig.yaml", rig)
    return path / "rig.yaml"


def plain_rig(lens: LensModel, count: int) -> StereoCalibration:
    K = np.array([[700.0, 0, 640], [0, 700, 360], [0, 0, 1]])
    camera = CameraIntrinsics(K, np.full(count, 0.01), *SIZE, lens)
    return StereoCalibration(camera, camera, make_transform(np.eye(3), np.array([-0.12, 0, 0])))


Write = Callable[[Path, StereoCalibration], Path]
WRITTEN: list[tuple[Write, LensModel, int]] = [
    *((each, "pinhole", 5) for each in (npz, zed, oak, oak_of_the_right, matlab, bouguet,
                                        realsense, orb_slam_3, orb_slam_2)),
    (oak, "fisheye", 4),
    (vins, "pinhole", 4), (vins, "fisheye", 4), (vins, "omni", 5), (basalt, "ds", 2),
    *((kalibr, lens, 4) for lens in ("ds", "eucm", "fov", "omni", "fisheye")),
    *((ours, lens, 4) for lens in ("ds", "eucm", "fov", "omni")),
]  # fmt: skip
QUICK = settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])


def same(have: object, want: StereoCalibration, tolerance: float = 1e-12) -> None:
    assert isinstance(have, StereoCalibration)
    np.testing.assert_allclose(have.T_right_left, want.T_right_left, atol=tolerance)
    for got, camera in ((have.left, want.left), (have.right, want.right)):
        np.testing.assert_allclose(got.matrix, camera.matrix, rtol=1e-12, atol=1e-10)
        padded = np.zeros(max(got.distortion.size, camera.distortion.size))
        padded[: camera.distortion.size] = camera.distortion
        wanted = np.pad(got.distortion, (0, padded.size - got.distortion.size))
        np.testing.assert_allclose(wanted, padded, rtol=1e-12)
        assert (got.model, got.width_px, got.height_px) == (camera.model, *SIZE)


@pytest.mark.parametrize(("write", "lens", "count"), WRITTEN)
@QUICK
@given(data=st.data())
def test_what_a_program_writes_of_a_rig_is_read_as_that_rig(tmp_path, write, lens, count, data):
    rig = data.draw(rigs(lens, count))
    same(read_calibration(write(tmp_path, rig), *SIZE), rig)


@pytest.mark.parametrize("names", [
    {"K1": "mtxL", "D1": "distL", "K2": "mtxR", "D2": "distR", "R": "Rot", "T": "Trns"},
    {"K1": "cameraMatrix1", "D1": "distCoeffs1", "K2": "cameraMatrix2", "D2": "distCoeffs2"},
    {"K1": "M1", "K2": "M2"}, {"K1": "camera_matrix_left", "K2": "camera_matrix_right"},
    {"K1": "K_l", "K2": "K_r", "D1": "D_l", "D2": "D_r"}, {"K1": "KL", "K2": "KR"},
    {"K1": "left_K", "K2": "right_K", "D1": "left_dist", "D2": "right_dist"},
    {"K1": "mtx1", "K2": "mtx2", "D1": "dist1", "D2": "dist2", "R": "rotation_matrix",
     "T": "translation_vector"},
    {"K1": "CM1", "K2": "CM2", "R": "R_stereo", "T": "T_stereo"},
    {"K1": "K0", "K2": "K1", "D1": "D0", "D2": "D1"},
    {"K1": "mtxl", "K2": "mtxr", "D1": "distl", "D2": "distr"},
    {"K1": "leftCameraMatrix", "K2": "rightCameraMatrix", "D1": "leftDistortion",
     "D2": "rightDistortion"},
])  # fmt: skip
@QUICK
@given(rig=rigs())
def test_arrays_of_numpy_are_read_under_the_names_that_people_give_them(tmp_path, names, rig):
    path = npz(tmp_path, rig, **names)
    same(read_calibration(path, *SIZE), rig)
    with pytest.raises(FormatError, match="does not contain the image size"):
        read_calibration(path)


@pytest.mark.parametrize("size", [{"image_size": SIZE}, {"image_shape": SIZE[::-1]},
                                  {"width": SIZE[0], "height": SIZE[1]}])  # fmt: skip
@QUICK
@given(rig=rigs())
def test_arrays_that_state_their_size_are_of_those_images(tmp_path, size, rig):
    T = rig.T_right_left
    np.savez(tmp_path / "c.npz", K1=rig.left.matrix, K2=rig.right.matrix, R=T[:3, :3], T=T[:3, 3],
             D1=rig.left.distortion, D2=rig.right.distortion, **size)  # fmt: skip
    same(read_calibration(tmp_path / "c.npz"), rig)
    with pytest.raises(CalibrationError, match="images have another size"):
        read_calibration(tmp_path / "c.npz", 640, 360)


def test_rectified_cameras_of_bare_numbers_and_settings_are_read(tmp_path):
    want = RectifiedCamera(700.0, 640.5, 360.0, 640.5, 0.12, *SIZE)
    (tmp_path / "K.txt").write_text("700 0 640.5 0 700 360 0 0 1\n0.12\n")
    pinhole = "Camera.fx: 700.0\nCamera.fy: 700.0\nCamera.cx: 640.5\nCamera.cy: 360.0\n"
    sized = f"%YAML:1.0\n{pinhole}Camera.width: 1280\nCamera.height: 720\n"
    (tmp_path / "two.yaml").write_text(sized + "Camera.bf: 84.0\nCamera.k1: 0.0\nViewer.Size:2\n")
    three = sized.replace("Camera.", "Camera1.").replace("Camera1.w", "Camera.w")
    (tmp_path / "three.yaml").write_text(
        three.replace("Camera1.h", "Camera.h") + "Stereo.b: 0.12\n"
    )
    for name in ("K.txt", "two.yaml", "three.yaml"):
        have = read_calibration(tmp_path / name, *SIZE)
        assert replace(have, baseline_m=0.12) == want
        assert have.baseline_m == pytest.approx(0.12, rel=1e-12)
    (tmp_path / "K.txt").write_text("700 0 640.5 0 700 360 0 0 1\n120\n")
    with pytest.raises(CalibrationError, match=r"implausibly long.*metres_per_unit"):
        read_calibration(tmp_path / "K.txt", *SIZE)
    assert read_calibration(tmp_path / "K.txt", *SIZE, metres_per_unit=1e-3).baseline_m == 0.12
    (tmp_path / "K.txt").write_text("700 0 640.5 0 700 360 0 0 1\n")
    with pytest.raises(FormatError, match=r"no pose of the right camera.*--focal PX"):
        read_calibration(tmp_path / "K.txt", *SIZE)


@pytest.mark.parametrize("given_to", ["intrinsics", "extrinsics"])
def test_two_files_of_a_realsense_are_read_as_one_from_either(tmp_path, given_to):
    camera = {"image_width": 1280, "image_height": 720,
              "projection": {"fx": 640.0, "fy": 640.0, "cx": 640.0, "cy": 360.0},
              "distortion": {"do_undistortion": False, "k1": 0.0, "k3": 0.0}}  # fmt: skip
    way = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
    poses = {f"body_to_{side}": {"position": {"x": x, "y": 0.0, "z": 0.0}, "orientation": way}
             for side, x in (("left", 0.0), ("right", 0.05))}  # fmt: skip
    (tmp_path / "d435_intrinsics.yaml").write_text(
        yaml.safe_dump({"left": camera, "right": camera})
    )
    (tmp_path / "d435_extrinsics.yaml").write_text(yaml.safe_dump(poses))
    have = read_calibration(tmp_path / f"d435_{given_to}.yaml", *SIZE)
    np.testing.assert_allclose(have.T_right_left[:3, 3], [-0.05, 0, 0], atol=1e-15)


def test_a_zed_has_cameras_for_its_own_sizes_alone(tmp_path):
    rig = plain_rig("pinhole", 5)
    path = zed(tmp_path, rig)
    assert read_calibration(path, 672, 376).left.matrix[0, 0] == 350
    with pytest.raises(CalibrationError, match="expected 2208x1242, 1280x720, 672x376"):
        read_calibration(path, 640, 480)
    with pytest.raises(FormatError, match="ZED does not say which images"):
        read_calibration(path)


class Bomb:
    """What a pickle would do to who loads it."""

    def __reduce__(self):
        return os.system, ("touch ran",)


@pytest.mark.parametrize("name", ["c.pkl", "c.p", "c.yaml", "c.npy", "c.npz"])
def test_pickles_are_refused_with_what_to_do_and_never_loaded(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / name
    if name == "c.npy":
        np.save(path, np.array([Bomb()]), allow_pickle=True)
    elif name == "c.npz":
        np.savez(path, K1=np.array([Bomb()]))
    else:
        path.write_bytes(pickle.dumps({"K1": Bomb()}))
    with pytest.raises(FormatError, match=r"c\.\w+: .*(pickle|one array).*np\.savez"):
        read_calibration(path, *SIZE)
    assert not (tmp_path / "ran").exists()


def test_matrices_of_rectified_views_are_not_taken_for_those_of_raw_cameras(tmp_path):
    K = np.array([[700.0, 0, 640], [0, 700, 360], [0, 0, 1]])
    P1, P2 = np.hstack([K, np.zeros((3, 1))]), np.hstack([K, [[-84.0], [0], [0]]])
    np.savez(tmp_path / "c.npz", newCameraMatrixL=K, newCameraMatrixR=K, P1=P1, P2=P2,
             R=np.eye(3), T=[-0.12, 0, 0])  # fmt: skip
    with pytest.raises(FormatError, match="no two camera matrices"):
        read_calibration(tmp_path / "c.npz", *SIZE)
    np.savez(tmp_path / "c.npz", P1=P1, P2=P2)
    assert read_calibration(tmp_path / "c.npz", *SIZE).baseline_m == pytest.approx(0.12)


def test_pickled_arrays_beside_matrices_are_left_out(tmp_path):
    K = np.array([[700.0, 0, 640], [0, 700, 360], [0, 0, 1]])
    rvecs = np.empty(2, dtype=object)
    np.savez(tmp_path / "c.npz", K1=K, K2=K, R=np.eye(3), T=[-0.1, 0, 0], rvecs=rvecs)
    assert read_calibration(tmp_path / "c.npz", *SIZE).baseline_m == pytest.approx(0.1)


def giant(path: Path) -> None:
    """An archive whose array claims a petabyte, and one that unpacks to a gigabyte."""
    head = io.BytesIO()
    shape = {"descr": "<f8", "fortran_order": False, "shape": (1 << 47,)}
    np.lib.format.write_array_header_1_0(head, shape)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("K1.npy", head.getvalue())
        with archive.open("D1.npy", "w", force_zip64=True) as member:
            for _ in range(64):
                member.write(bytes(1 << 20))


def unpacking(path: Path) -> None:
    """A file of MATLAB with a variable that unpacks to 64 MB."""
    packed = zlib.compress(bytes(1 << 26))
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    path.write_bytes(head + (15).to_bytes(4, "little") + len(packed).to_bytes(4, "little") + packed)


def newer(path: Path) -> None:
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n")


@pytest.mark.parametrize(("write", "name", "message"), [
    (giant, "c.npz", r"c\.npz: content"),
    (unpacking, "c.mat", "too large for a calibration"),
    (newer, "c.mat", "MATLAB 7.3.*save.*-v7"),
    (lambda path: path.symlink_to(path), "c.npz", "c.npz"),
    (os.mkfifo, "c.mat", "not a regular file"),
    (lambda path: path.write_text("[a]\nb\n"), "SN1.conf", "not a file of calibrations|known kind"),
    (lambda path: path.write_text('{"a": ' + "[" * 100_000), "c.json",  "nested too|not a file"),
])  # fmt: skip
def test_what_is_hostile_is_one_clear_line(tmp_path, write, name, message):
    write(tmp_path / name)
    with pytest.raises(ReconError, match=message) as caught:
        read_calibration(tmp_path / name, *SIZE)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("write", "lens", "count"), WRITTEN[:12])
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_is_read_or_one_clear_line(tmp_path, write, lens, count, data):
    rig = plain_rig(lens, count)
    path = write(tmp_path, rig)
    whole = path.read_bytes()
    at = data.draw(st.integers(0, len(whole) - 1))
    other = data.draw(st.sampled_from([b"", b"nan", b"1e400", b"-", b"\xff\x00", b"]", b"9" * 30]))
    cut = data.draw(st.integers(0, 40))
    path.write_bytes(whole[:at] + other + whole[at + cut :] if cut else whole[:at])
    with suppress(ReconError):  # and nothing else
        read_calibration(path, *SIZE)


def test_no_damage_to_a_file_of_matlab_ends_the_process(tmp_path):
    generator = np.random.default_rng(3)
    values = loadmat(matlab(tmp_path, plain_rig("pinhole", 5)), simplify_cells=True)
    savemat(tmp_path / "c.mat", {"p": values["stereoParams"]})  # not compressed
    whole = (tmp_path / "c.mat").read_bytes()
    for _ in range(400):
        damaged = np.frombuffer(whole, np.uint8).copy()
        damaged[generator.integers(120, damaged.size, 3)] = generator.choice([0, 1, 14, 15, 255], 3)
        (tmp_path / "c.mat").write_bytes(damaged.tobytes()[: generator.integers(1, 2 * len(whole))])
        with suppress(ReconError):  # and nothing else
            read_calibration(tmp_path / "c.mat", *SIZE)


@pytest.mark.parametrize(
    ("unit", "metres"), [("millimeters", 0.001), ("m", 1.0), ("inches", 0.0254)]
)
def test_lengths_of_matlab_are_in_the_unit_that_it_names(tmp_path, unit, metres):
    values = loadmat(matlab(tmp_path, plain_rig("pinhole", 5)), simplify_cells=True)
    parts = values["stereoParams"]
    parts["WorldUnits"], parts["TranslationOfCamera2"] = unit, np.array([-0.12, 0, 0]) / metres
    savemat(tmp_path / "c.mat", {"p": parts})
    assert read_calibration(tmp_path / "c.mat", *SIZE).baseline_m == pytest.approx(0.12)


def test_lists_of_whole_numbers_have_no_decimal_commas(tmp_path):
    K = [[700, 0, 640], [0, 700, 360], [0, 0, 1]]
    content = {"K1": K, "K2": K, "R": np.eye(3, dtype=int).tolist(), "T": [-1, 0, 0]}
    (tmp_path / "c.json").write_text(json.dumps(content, separators=(",", ":")))
    assert read_calibration(tmp_path / "c.json", *SIZE).baseline_m == 1.0
    (tmp_path / "c.json").write_text('{"K1": [[700,5, 0, 640,2], [0, 700,5, 360], [0, 0, 1]]}')
    with pytest.raises(FormatError, match="decimals are written with a comma"):
        read_calibration(tmp_path / "c.json", *SIZE)


@pytest.mark.parametrize("count", [1, 2, 3, 6, 15])
def test_no_lens_has_coefficients_that_opencv_cannot_take(count):
    K = np.array([[700.0, 0, 640], [0, 700, 360], [0, 0, 1]])
    with pytest.raises(CalibrationError, match="distortion has the wrong size"):
        CameraIntrinsics(K, np.zeros(count), *SIZE)


def test_a_pose_may_have_three_rows(tmp_path):
    K = np.array([[700.0, 0, 640], [0, 700, 360], [0, 0, 1]])
    T = make_transform(np.eye(3), np.array([-0.1, 0, 0]))
    np.savez(tmp_path / "c.npz", K1=K, K2=K, T_right_left=T[:3])
    assert read_calibration(tmp_path / "c.npz", *SIZE).baseline_m == pytest.approx(0.1)


def test_an_archive_of_remapping_tables_alone_is_no_pickle(tmp_path):
    np.savez(tmp_path / "c.npz", stereoMapL_x=np.zeros((720, 1280), np.float32))
    with pytest.raises(FormatError, match=r"no matrices of cameras, but .*large tables"):
        read_calibration(tmp_path / "c.npz", *SIZE)


@pytest.mark.parametrize("name", ["SN123.conf", "stereo_calib.npz", "Calib_Results_stereo.mat",
                                  "K.txt", "camchain-x.yaml", "oak_calib.json", "stereo.mat",
                                  "d435_intrinsics.yaml", "calibration_data.npz"])  # fmt: skip
def test_calibrations_of_a_folder_are_found_by_the_names_programs_give_them(tmp_path, name):
    for other in ("times.txt", "points.npz", "results.json", "notes.conf"):
        (tmp_path / other).write_text("")
    (tmp_path / name).write_text("")
    assert find_calibration(tmp_path) == tmp_path / name
