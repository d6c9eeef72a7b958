"""The calibration in a file of any program, found by names and shapes of what is in it.

Programs call the same few things by different names: ``names.toml`` beside this file has them.
What is asked of a file is two cameras first, and then how they stand to each other.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import numpy as np

from recon.core.errors import CalibrationError, FormatError
from recon.core.geometry.se3 import exp_so3, invert, make_transform, rotation_from_quaternion
from recon.core.text import counted
from recon.core.values import (
    LENS_COEFFICIENTS,
    PINHOLE_COUNTS,
    CameraIntrinsics,
    LensModel,
    RectifiedCamera,
    Rig,
    StereoCalibration,
    check_rotation,
    check_unsized,
    other_size,
)
from recon.core.values.arrays import Float64
from recon.io.cameras.contents import SAVE, Contents, Value, read_contents
from recon.io.cameras.kitti import projected_rig
from recon.io.cameras.ros import (
    camera_info_paths,
    in_options,
    pinhole_matrix,
    rig_of_camera_infos,
)
from recon.io.fields import read_toml
from recon.io.files import StrPath, reader

Side = Literal["left", "right", ""]
Size = tuple[int, int]

INSTEAD: Final = (
    f"calibrate both cameras as a pair, and {SAVE}; of rectified images --focal PX and --baseline "
    "M are enough"
)
"""What to do with a calibration that is not read."""
_BOTH: Final[tuple[Side, Side]] = ("left", "right")
_SIDES: Final = (("left", "right"), ("l", "r"), ("0", "1"), ("1", "2"))
_WORD: Final = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_GLUED: Final = re.compile(r"([KDMPkdmp]|mtx|dist)([LRlr])")  # ``mtxl``, ``KL``: name and side
_OTHERS: Final = re.compile(  # matrices that have been called as those that are looked for
    r"new|optimal|rect(?!ification_matrix)|fundamental|essential|homography|error|std|uncertainty|"
    r"roi|distorted",
    re.I,
)
_TABLES: Final = read_toml(Path(__file__).with_name("names.toml"))
_FIELDS: Final = {k: (v[0].split(), frozenset(v[1:])) for k, v in _TABLES["fields"].items()}
_LENS_OF: Final[dict[str, LensModel]] = {
    name: lens for lens, names in _TABLES["lenses"].items() for name in names.split()
}
_WHOLE: Final = frozenset(_TABLES["words"]["whole"].split())
_OF_CAMERAS: Final = frozenset(name for field in "KDP" for name in _FIELDS[field][0])
# OpenCV names no lens model, and both have four coefficients. A pinhole that sees more than 90
# degrees has a distortion above this; a fisheye's polynomial is close to 1.
_FISHEYE_LIKE: Final = 0.1
_LONGEST_BASELINE_M: Final = 20.0  # longer than any rig: millimetres read as metres
_MOST_SHOWN: Final = 8  # names of a file in an error


@reader
def read_named(
    path: StrPath, size_px: Size | None = None, *, metres_per_unit: float | None = None
) -> Rig | None:
    """Read the rig of a file by the names in it; None = there is no camera.

    Files that belong together are read as one: ``intrinsics`` and ``extrinsics``, ``left`` and
    ``right``, the two that a third names. ``size_px`` (width, height) is for files that do not
    state it; ``metres_per_unit`` is the unit of lengths, None = the program's, of a baseline
    that a rig may have.
    """
    contents = _with_others(Path(path), read_contents(path))
    keys = list(contents) or [""]
    form, unit_m = next(
        form for sign, form in _TABLES["forms"].items() if any(re.match(sign, key) for key in keys)
    )
    units = next((str(value) for key, value in contents.items() if "WorldUnits" in key), "")
    unit_m = _TABLES["units"].get(units, unit_m)
    if "ZED" in form:
        contents, size_px = _of_resolution(contents, size_px, path)
    if "OAK" in form:
        contents = _of_sockets(contents)
    named = _Named(contents, form, path, metres_per_unit or unit_m)
    rig = named.rig(size_px)
    if metres_per_unit is None and rig is not None:
        _check_unit(rig.baseline_m)
    return rig


def lens_called(name: str) -> LensModel:
    """Return our lens model by what any program calls it."""
    lens = _LENS_OF.get(re.sub(r"[^a-z0-9]", "", name.lower()))
    if lens is None:
        what, hint = "lens model is not supported", "calibrate again with one of these; fisheye is "
        expected, hint = ", ".join(LENS_COEFFICIENTS), f"{hint}for wide lenses"
        raise FormatError(what, got=name, expected=expected, hint=hint)
    return lens


@reader
def read_euroc_camera(path: StrPath) -> tuple[CameraIntrinsics, Float64]:
    """Read a camera from its ``sensor.yaml``, and ``T_body_camera`` (4, 4), metres."""
    named = _Named(read_contents(path), "sensor.yaml", path, 1.0)
    T = named.in_body("")
    if T is None:
        raise FormatError("sensor.yaml has no T_BS")
    return named.camera("", named.matrix(""), None), T


def _with_others(path: Path, contents: Contents) -> Contents:
    """Return the contents together with those of the files that belong to a file."""
    for one, other in (("intrinsics", "extrinsics"), ("extrinsics", "intrinsics")):
        beside = path.with_name(path.name.replace(one, other))
        if one in path.name and beside.is_file():
            contents = {**read_contents(beside), **contents}
    named = [str(contents.get(f"cam{number}_calib", "")) for number in (0, 1)]
    pair = [path.with_name(name) for name in named] if all(named) else camera_info_paths(path)
    if all(named) or (path in pair and all(each.is_file() for each in pair)):
        for side, each in zip(_BOTH, pair, strict=True):
            contents |= {f"{side}.{key}": value for key, value in read_contents(each).items()}
    elif "projection_matrix" in contents:
        missing = next((each for each in pair if not each.is_file()), pair[1])
        hint = "give both files the same name but for 'left' and 'right'"
        raise FormatError("CameraInfo of the other camera is missing", where=missing, hint=hint)
    return contents


def _of_resolution(
    contents: Contents, size_px: Size | None, where: StrPath
) -> tuple[Contents, Size]:
    """Return what a ZED's file says of the cameras at one resolution."""
    sizes = {tuple(size): name for name, size in _TABLES["zed"].items()}
    known = {size: name for size, name in sizes.items() if f"LEFT_CAM_{name}.fx" in contents}
    expected = ", ".join(f"{width}x{height}" for width, height in known)
    if size_px is None:
        what = "the factory calibration of a ZED does not say which images it is of"
        raise FormatError(what, expected=expected, hint="pass width_px and height_px")
    if size_px not in known:
        raise other_size(*size_px, expected, where)
    for old in (rf"_CAM_{known[size_px]}(?=\.)", rf"^STEREO\.|_{known[size_px]}$"):
        contents = {re.sub(old, "", key): value for key, value in contents.items()}
    return {key: value for key, value in contents.items() if "_" not in key}, size_px


def _of_sockets(contents: Contents) -> Contents:
    """Return what an OAK's file says of the cameras of its stereo pair."""
    found: Contents = {}
    sockets = [contents.get(f"stereoRectificationData.{side}CameraSocket") for side in _BOTH]
    for side, socket, other in zip(_BOTH, sockets, sockets[::-1], strict=True):
        start = f"cameraData.{socket:g}." if isinstance(socket, np.ndarray) else "?"
        own = {k.removeprefix(start): v for k, v in contents.items() if k.startswith(start)}
        leads = own.get("extrinsics.toCameraSocket") == other
        found |= {f"{side}.{key}": v for key, v in own.items() if "extrinsics" not in key}
        for key in ("rotationMatrix", "translation") if leads else ():
            found[("" if side == "left" else "inverse") + key] = own.get(f"extrinsics.{key}", "")
    return found


class _Named:
    """Contents of a file, by side and name."""

    def __init__(self, contents: Contents, form: str, where: StrPath, unit_m: float) -> None:
        self._form, self._where, self._unit_m, self._contents = form, where, unit_m, contents
        renamed = contents
        for old, new in _TABLES["renamed"].items():
            renamed = {re.sub(old, new, key): value for key, value in renamed.items()}
        words = {k: _words(k, v) for k, v in renamed.items() if not _OTHERS.search(k)}
        known = {" ".join(each) for each in words.values()}
        zeros = [_twin(each, each.index("0"), "1") for each in words.values() if "0" in each]
        # Of three cameras the first two.
        sides = (*_SIDES[:2], _SIDES[2] if known.intersection(zeros) else _SIDES[3])
        sided = [(*_sided(each, known, sides), renamed[key]) for key, each in words.items()]
        self._values: dict[tuple[Side, str], Value] = {}
        for at in range(max(map(len, words.values()), default=0)):  # whole names first
            for side, rest, value in sided:
                if at < len(rest):
                    self._values.setdefault((side, "".join(rest[at:])), value)

    def find(self, field: str, *sides: Side) -> Float64 | None:
        """Return the numbers of a field, of the first side that has them (none: of no side)."""
        names, sizes = _FIELDS.get(field, ([field], {1}))
        for side in sides or ("",):
            for value in (self._values.get((side, name)) for name in names):
                if isinstance(value, np.ndarray) and value.size in sizes:
                    return value
        return None

    def number(self, field: str, *sides: Side) -> float | None:
        found = self.find(field, *sides)
        return None if found is None else float(found.item())

    def rig(self, size_px: Size | None) -> Rig | None:
        """Return the rig that the names are of; None = there is no camera in them."""
        left, right, one = (self.matrix(side) for side in (*_BOTH, ""))
        turns, projections = [self.find("rectifying", side) for side in _BOTH], self._projections()
        if left is None and right is None and one is None:
            if projections is None:
                return None
            if self.find("rotation") is not None:  # of raw cameras, that are called otherwise
                self.camera("", None, size_px)
            named = {"P1": projections[0], "P2": projections[1]}
            camera = self.camera("left", named["P1"][:, :3], size_px)
            return projected_rig(named, camera.width_px, camera.height_px)
        if left is None or right is None:
            return self._rectified(*2 * (self.camera("", one, size_px),))
        cameras = self.camera("left", left, size_px), self.camera("right", right, size_px)
        T = self._pose()
        if T is not None:
            T[:3, 3] *= self._unit_m
            return StereoCalibration(*cameras, T)
        if turns[0] is None or turns[1] is None or projections is None:
            return self._rectified(*cameras)
        both = (cameras[0], turns[0].reshape(3, 3)), (cameras[1], turns[1].reshape(3, 3))
        return rig_of_camera_infos(*both, projections, self._where, size_px)

    def matrix(self, side: Side) -> Float64 | None:
        """Return the camera matrix (3, 3) of a side, pixel centres at integers; None = none."""
        found, vector = self.find("K", side), self.find("vector", side)
        focal, centre = self.find("focal", side), self.find("centre", side)
        numbers = [self.number(each, side) for each in ("fx", "fy", "cx", "cy")]
        if found is not None:
            matrix = np.array(found.reshape(3, 3))
            if matrix[2, :2].any() and not matrix[:2, 2].any():  # MATLAB's, whose points are rows
                matrix = matrix.T
        elif focal is not None and centre is not None:
            matrix = pinhole_matrix(*focal.ravel(), *centre.ravel())
        elif None not in numbers or vector is not None:
            matrix = pinhole_matrix(*(numbers if vector is None else vector.ravel()[-4:]))
        else:
            return None
        if "MATLAB" in self._form:
            matrix[:2, 2] -= 1  # its first pixel is (1, 1)
        return matrix

    def camera(self, side: Side, matrix: Float64 | None, size_px: Size | None) -> CameraIntrinsics:
        if matrix is None:
            raise self._lacks("two camera matrices", "K1 and K2, or mtxL and mtxR")
        stated = self._size(side)
        size = stated or size_px
        if size is None:
            raise FormatError(
                f"{self._form} does not contain the image size",
                expected="image_width and image_height",
                hint="from Python: pass width_px and height_px, or give the file itself to "
                "recon.reconstruct or recon.match, which take the size from the images",
            )
        if stated is None and side != "right":
            check_unsized((matrix[0, 2], matrix[1, 2]), *size, self._where)
        lens = self._lens(side)
        camera = CameraIntrinsics(
            matrix, self._distortion(side, lens or "pinhole"), *size, lens or "pinhole"
        )
        largest, wide = np.abs(camera.distortion).max(initial=0.0), size[0] / 2 > matrix[0, 0]
        if camera.distortion.size == 4 and lens is None and wide and 0 < largest < _FISHEYE_LIKE:
            raise FormatError(  # the lenses may as well be fisheyes
                "calibration does not say which lens model its four coefficients belong to",
                expected="a line 'distortion_model: fisheye', or 'distortion_model: pinhole'",
            )
        return camera

    def _size(self, side: Side) -> Size | None:
        numbers = [self.number(each, side, "") for each in ("width", "height")]
        both, shape = self.find("size", side, ""), self.find("shape", side, "")
        if None not in numbers:
            both = np.array(numbers)
        elif both is not None and "MATLAB" in self._form:
            both = both[::-1]
        elif shape is not None:
            both = shape[1::-1]
        if both is None:
            return None
        width, height = both.ravel()[:2].tolist()
        if not all(abs(side) < 1e9 and side == int(side) for side in (width, height)):
            raise FormatError("image size is not in whole pixels", got=f"{width} x {height}")
        return int(width), int(height)

    def _models(self, side: Side) -> list[str]:
        """Return what a file calls the lens model, in small letters alone."""
        found = []
        for name in _TABLES["words"]["models"].split():
            value = self._values.get((side, name), self._values.get(("", name), ""))
            if isinstance(value, np.ndarray):
                value = f"{value.item():g}" if "OAK" in self._form and value.size == 1 else ""
            plain = re.sub(r"[^a-z0-9]", "", value.lower()).removeprefix("distortion")
            if plain and (plain in _LENS_OF or name != "model"):  # that may be of the camera
                found.append(plain)
        return found

    def _lens(self, side: Side) -> LensModel | None:
        """Return the lens model that a file names: if it names two, the one that is no pinhole."""
        lenses = sorted(map(lens_called, self._models(side)), key="pinhole".__eq__)
        return lenses[0] if lenses else None

    def _distortion(self, side: Side, lens: LensModel) -> Float64:
        vector, given = self.find("vector", side), self.find("D", side, "")
        head = np.zeros(0) if vector is None else vector.ravel()[:-4]
        radial, across = self.find("radial", side), self.find("tangential", side)
        if radial is not None and across is not None:
            given = np.concatenate([radial.ravel()[:2], across.ravel(), radial.ravel()[2:]])
        wrong = [self._values.get((side, name)) for name in _FIELDS["D"][0]]
        sizes = [each.size for each in wrong if isinstance(each, np.ndarray)]
        if given is None and not sizes:
            names = LENS_COEFFICIENTS[lens][head.size : 12]  # a tilted sensor's are in no file
            given = np.array([self.number(name, side, "") or 0.0 for name in names])
            if lens == "pinhole":
                given = given[: next(n for n in PINHOLE_COUNTS if not given[n:].any())]
        most = len(LENS_COEFFICIENTS[lens]) - head.size
        if given is not None and not given.ravel()[most:].any():  # padded, as OAK's are
            given = given.ravel()[:most]
        if given is None:
            what, got = "distortion has the wrong size", counted(sizes[0], "coefficient")
            raise FormatError(what, got=got, expected="4, 5, 8, 12 or 14")
        if given.any() and "none" in self._models(side):
            raise FormatError("a lens without distortion has coefficients", got=given.tolist())
        return np.concatenate([head, given.ravel()])

    def _pose(self) -> Float64 | None:
        """Return ``T_right_left`` (4, 4) in units of the file; None = there is none."""
        for field in ("right_left", "left_right"):
            # Of more than two cameras, the second has that from the first.
            if (found := self.find(field, "", *_BOTH)) is not None:
                return _rigid(found) if field == "right_left" else invert(_rigid(found))
        for way in ("", "_rows", "_back"):
            turn, step = self.find(f"rotation{way}"), self.find(f"translation{way}")
            if turn is not None and step is not None:
                R = exp_so3(turn.ravel()) if turn.size == 3 else turn.reshape(3, 3)
                columns = "RealSense" in self._form and turn.ndim == 1
                T = make_transform(R.T if columns or way == "_rows" else R, step.ravel())
                return invert(_rigid(T)) if way == "_back" else T
        bodies = [self.in_body(side) for side in _BOTH]
        if bodies[0] is not None and bodies[1] is not None:
            return np.asarray(invert(bodies[1]) @ bodies[0])
        zed = [self.number(name) for name in ("baseline", "ty", "tz", "rx", "cv", "rz")]
        if zed[0] is None or None in zed[3:]:
            return None
        # The place of the right camera, and the turn of points to it.
        numbers = np.array([each or 0.0 for each in zed])
        return make_transform(exp_so3(numbers[3:]), -numbers[:3])

    def in_body(self, side: Side) -> Float64 | None:
        """Return ``T_body_camera`` (4, 4) of a side; None = it is not there."""
        ahead, back = self.find("body_camera", side), self.find("camera_body", side)
        place, way = self.find("position", side), self.find("orientation", side)
        if place is not None and way is not None:
            ahead = np.concatenate([place.ravel(), way.ravel()])
        if ahead is None:
            return None if back is None else invert(_rigid(back))
        return _rigid(ahead)

    def _projections(self) -> tuple[Float64, Float64] | None:
        """Return both ``P`` (3, 4), metres; None = they are not there."""
        left, right = (self.find("P", side) for side in _BOTH)
        if left is None or right is None:
            return None
        scale = np.array([1.0, 1.0, 1.0, self._unit_m])
        return left.reshape(3, 4) * scale, right.reshape(3, 4) * scale

    def _rectified(self, left: CameraIntrinsics, right: CameraIntrinsics) -> RectifiedCamera:
        """Return the rectified camera of matrices and a baseline, where that is all there is."""
        bf, baseline = self.number("bf"), self.number("baseline")
        f, cx, cy = (float(left.matrix[at]) for at in ((0, 0), (0, 2), (1, 2)))
        if baseline is None and bf is not None:
            baseline = bf / f
        if baseline is None or left.distortion.any() or right.distortion.any():
            raise self._lacks("pose of the right camera", "R and T, or a matrix 4x4")
        baseline_m = baseline * self._unit_m
        if "ORB" in self._form and self.find("K", *_BOTH) is not None:
            what = "settings of ORB-SLAM for raw images are not complete"
            given = f"if the images are rectified give {in_options(f, baseline_m, cx, cy)}"
            raise FormatError(what, expected="K, D, R and P of LEFT and RIGHT", hint=given)
        size = left.width_px, left.height_px
        return RectifiedCamera.from_matrices(left.matrix, right.matrix, baseline_m, *size)

    def _lacks(self, what: str, expected: str) -> FormatError:
        names = [
            f"{key} ({counted(value.size, 'number')})" if isinstance(value, np.ndarray) else key
            for key, value in self._contents.items()
        ]
        got = ", ".join(names[:_MOST_SHOWN]) + (" …" if len(names) > _MOST_SHOWN else "")
        other = "give the settings with cam0_calib and body_T_cam0" if "VINS" in self._form else ""
        what = f"{self._form} has no {what}"
        return FormatError(what, got=got, expected=expected, hint=other or INSTEAD)


def _check_unit(baseline_m: float) -> None:
    if baseline_m > _LONGEST_BASELINE_M:
        what = "baseline is implausibly long"
        got, expected = f"{baseline_m:g} m", f"at most {_LONGEST_BASELINE_M:g} m"
        hint = "in millimetres? --set source.metres_per_unit=0.001 (1 if it is right), in Python "
        hint += "metres_per_unit=0.001"
        raise CalibrationError(what, got=got, expected=expected, hint=hint)


def _rigid(pose: Float64) -> Float64:
    """Return a pose (4, 4) of sixteen numbers, or of a position and a quaternion."""
    values = pose.ravel()
    if values.size in (12, 16):
        rows = values.reshape(-1, 4)
        T = make_transform(rows[:3, :3], rows[:3, 3])
        check_rotation(T[:3, :3], "rotation of a pose")
        return T
    length = np.linalg.norm(values[3:])
    if not 0.5 < length < 2:
        raise CalibrationError("orientation of a camera is no quaternion", got=values[3:].tolist())
    return make_transform(rotation_from_quaternion(values[3:] / length), values[:3])


def _words(key: str, value: Value) -> list[str]:
    """Return the words of a name, in small letters; that of a number may have one that is whole."""
    parts = [part for part in re.split(r"[._\s-]+", key) if part]
    one = isinstance(value, np.ndarray) and value.size == 1
    whole = [part.lower() for part in parts if one and part.lower() in _WHOLE][:1]
    words: list[str] = []
    for part in parts:
        glued = _GLUED.fullmatch(part)
        if part.lower() not in whole:
            words += glued.groups() if glued else _WORD.findall(part)
    return [word.lower() for word in words] + whole


def _sided(
    words: list[str], known: set[str], sides: Sequence[tuple[str, str]]
) -> tuple[Side, list[str]]:
    """Return the side of a name, and its other words.

    ``R``, ``1`` and the like are a side if the same name is there with the other one, else if it
    is the name of a matrix of cameras.
    """
    for alone in (False, True):
        for names in sides:
            for at in (at for at, word in enumerate(words) if word in names and len(words) > 1):
                rest, right = words[:at] + words[at + 1 :], words[at] == names[1]
                named = alone and rest[-1] in _OF_CAMERAS
                if named or _twin(words, at, names[not right]) in known:
                    return _BOTH[right], rest
    return "", words


def _twin(words: list[str], at: int, other: str) -> str:
    return " ".join([*words[:at], other, *words[at + 1 :]])
