"""Structure from motion over all pairs of a source, before the first of them is mapped, by COLMAP.

Features of every image, matches between pairs that may see the same, and a model that grows by one
pair after another, adjusted as a whole. The rig is held, so lengths are metres. Pairs that share
nothing are in models of their own.

Ref: Schönberger, Frahm, "Structure-from-motion revisited", CVPR 2016.
"""

from __future__ import annotations

import math
import signal
import tempfile
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from recon.core.errors import RegistrationError, SettingsError, require
from recon.core.geometry.se3 import apply, invert
from recon.core.summary import Figures
from recon.core.text import counted
from recon.core.values import RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Float32, Float64, Int64, UInt8
from recon.core.work import Stopwatch, side_by_side
from recon.odometry.health import name_frames
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult
from recon.sources.source import StereoSource, check_source
from recon.stereo.rectify.rectifier import RectificationSettings, Rectifier

_PIXELS: Final = 1_300_000
"""Of the image in which features are found; larger ones are shrunk. They stay accurate to a tenth
of a pixel there, and SIFT takes some 240 bytes for each pixel, in every thread."""
_PIXEL_BYTES: Final = 240
_FEATURES: Final = 1500  # most features of an image, the strongest
_CONTRAST: Final = 0.02  # half of OpenCV's default: weak features still tell walls apart
_ALL: Final = 200  # pairs up to which each is matched with every other
_ALIKE: Final = 80  # images of more pairs that each is matched with: those that look most alike
_NEXT: Final = (1, 2, 4, 8, 16)  # and pairs later in order, which are near if it was a drive
_WORDS: Final = 4096  # by which images look alike; learnt from their own features
_FEATURES_PER_WORD: Final = 24  # from which words are learnt
_SIGMA_PX: Final = 0.4
"""Standard deviation of a feature, in pixels of the image in which it is found. All thresholds are
multiples of it: COLMAP's own at that size, but for what is left out of the model (it has 10)."""
_VERIFIED: Final = 10.0  # matches nearer than this to their epipolar lines agree with a motion
_REGISTERED: Final = 30.0  # points nearer than this to their features agree with a first pose
_LEFT_OUT: Final = 5.0  # features farther than this from their point are left out of a model
_ROBUST: Final = 2.5  # residuals beyond which features count less and less in the last adjustment
_ITERATIONS: Final = 25  # most of that adjustment
_CONVERGED: Final = 1e-6  # share by which its cost must shrink to go on
_SEED: Final = 0
_LEFT, _RIGHT = "left", "right"  # what names of images begin with


def load_colmap() -> Any:
    """Import COLMAP, which takes SIGTERM as a crash, and leave that signal to who had it before."""
    before = signal.getsignal(signal.SIGTERM)
    api = require("pycolmap", extra="sfm")
    if threading.current_thread() is threading.main_thread():  # elsewhere Python sets no handler
        signal.signal(signal.SIGTERM, before)
    return api


class Colmap:
    """COLMAP at work on the pairs of a rectified camera, with its database in a folder."""

    def __init__(
        self, camera: RectifiedCamera, folder: Path, threads: int, limit_mb: float | None
    ) -> None:
        self._api = load_colmap()
        self._api.logging.minloglevel = int(self._api.logging.Level.FATAL.value)
        self._api.set_random_seed(_SEED)
        self._camera, self._folder, self._threads = camera, folder, threads
        self._database = folder / "colmap.db"
        quarter = math.inf if limit_mb is None else 1e6 * limit_mb / 4  # of the memory, bytes
        self._most_pixels = min(_PIXELS, quarter / (_PIXEL_BYTES * threads))
        shrunk = camera.width_px * camera.height_px / self._most_pixels
        self._sigma_px = _SIGMA_PX * max(1.0, math.sqrt(shrunk))

    def add_features(self, pairs: Iterable[RectifiedPair]) -> None:
        sides = (side for pair in pairs for side in (pair.left, pair.right))
        most, api = self._most_pixels, self._api
        found = side_by_side(lambda im: find_features(im, most), sides, threads=self._threads)
        with self._opened() as database, api.DatabaseTransaction(database):
            cameras = [database.write_camera(one) for one in self._cameras()]
            for number, (places, descriptors) in enumerate(found):
                pair, right = divmod(number, 2)
                name = _name(pair, right=bool(right))
                image = database.write_image(api.Image(name=name, camera_id=cameras[right]))
                kind = api.FeatureExtractorType.SIFT
                database.write_keypoints(image, places)
                database.write_descriptors(image, api.FeatureDescriptors(kind, descriptors))
        with self._opened() as database:
            api.apply_rig_config([self._rig()], database)

    def match(self, pairs: int) -> None:
        """Match images that may see the same, and check that one motion explains each match."""
        api, listed = self._api, self._folder / "pairs.txt"
        every = [(n, m) for n in range(pairs) for m in range(n + 1, pairs)]
        chosen = every if pairs <= _ALL else self._alike(pairs)
        names = [(_name(n), _name(n, right=True)) for n in range(pairs)]
        names += [(_name(n), _name(m)) for n, m in chosen]
        listed.write_text("".join(f"{one} {other}\n" for one, other in names), "utf-8")
        matching, pairing = api.FeatureMatchingOptions(), api.ImportedPairingOptions()
        verification = api.TwoViewGeometryOptions()
        matching.num_threads, pairing.match_list_path = self._threads, str(listed)
        verification.ransac.random_seed = _SEED
        verification.ransac.max_error = _VERIFIED * self._sigma_px
        api.match_image_pairs(str(self._database), matching, pairing, verification, api.Device.cpu)

    def map(self) -> tuple[Model, ...]:
        """Return all models that the matches give, the largest first."""
        api, options = self._api, self._api.IncrementalPipelineOptions()
        options.num_threads = options.mapper.num_threads = self._threads
        options.random_seed = options.mapper.random_seed = _SEED
        options.triangulation.random_seed = _SEED
        options.min_model_size = 2
        options.extract_colors = False
        _hold_rig(options, "ba_refine_")
        options.mapper.init_max_error = _VERIFIED * self._sigma_px
        options.mapper.abs_pose_max_error = _REGISTERED * self._sigma_px
        options.mapper.filter_max_reproj_error = _LEFT_OUT * self._sigma_px
        options.triangulation.merge_max_reproj_error = _LEFT_OUT * self._sigma_px
        options.triangulation.complete_max_reproj_error = _LEFT_OUT * self._sigma_px
        options.mapper.abs_pose_refine_focal_length = False
        options.mapper.abs_pose_refine_extra_params = False
        models, images = self._folder / "models", self._folder / "images"
        models.mkdir()
        images.mkdir()
        found = api.incremental_mapping(
            str(self._database), str(images), str(models), options=options
        )
        by_size = sorted(found.values(), key=lambda one: -one.num_reg_frames())
        for model in by_size:
            self._adjust(model)
        return _apart([_read_model(one, self._camera) for one in by_size])

    def _adjust(self, model: Any) -> None:
        """Adjust a model once more, so that wrong matches that are left count little."""
        options = self._api.BundleAdjustmentOptions()
        _hold_rig(options, "refine_")
        options.print_summary = False
        options.ceres.loss_function_type = self._api.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = _ROBUST * self._sigma_px
        solver = options.ceres.solver_options
        solver.num_threads, solver.max_num_iterations = self._threads, _ITERATIONS
        solver.function_tolerance = _CONVERGED
        # `bundle_adjustment`, which does all this at once, prints, whatever it was told.
        adjusted = self._api.BundleAdjustmentConfig()
        adjusted.set_constant_rig_from_world_pose(model.reg_frame_ids()[0])
        for image in model.images.values():
            if image.has_pose:
                adjusted.add_image(image.image_id)
        self._api.create_default_ceres_bundle_adjuster(options, adjusted, model).solve()
        model.update_point_3d_errors()

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        database = self._api.Database.open(str(self._database))
        try:
            yield database
        finally:
            database.close()

    def _cameras(self) -> Iterator[Any]:
        """Yield the left and the right camera; COLMAP's pixels have their centres at a half."""
        camera = self._camera
        f, cy = camera.focal_px, camera.cy_px + 0.5
        for cx_px in (camera.cx_px, camera.cx_right_px):
            size = {"width": camera.width_px, "height": camera.height_px}
            one = self._api.Camera(model="PINHOLE", params=[f, f, cx_px + 0.5, cy], **size)
            one.has_prior_focal_length = True
            yield one

    def _rig(self) -> Any:
        api, rig = self._api, self._api.RigConfig()
        left, right = api.RigConfigCamera(), api.RigConfigCamera()
        left.ref_sensor, left.image_prefix, right.image_prefix = True, _LEFT, _RIGHT
        beside = np.array([[-self._camera.baseline_m], [0.0], [0.0]])
        right.cam_from_rig = api.Rigid3d(np.hstack([np.eye(3), beside]))
        rig.cameras = [left, right]
        return rig

    def _alike(self, pairs: int) -> list[tuple[int, int]]:
        """Return pairs that look alike by the words of their features, and those in order."""
        api, words = self._api, self._folder / "words.bin"
        options = api.VocabTreePairingOptions()
        options.vocab_tree_path, options.num_images = str(words), _ALIKE
        options.num_threads = self._threads
        with self._opened() as database:
            images = {one.image_id: one.name for one in database.read_all_images()}
            self._learn_words(database, list(images), words)
            lefts = [number for number, name in images.items() if name.startswith(_LEFT)]
            asked = api.VocabTreePairGenerator(options, database, lefts).all_pairs()
        found = {(n, n + step) for step in _NEXT for n in range(pairs - step)}
        for both in asked:
            n, m = sorted(_number(images[image]) for image in both)
            found |= {(n, m)} if n < m else set()
        return sorted(found)

    def _learn_words(self, database: Any, images: Sequence[int], words: Path) -> None:
        """Learn from the features themselves which are the same word."""
        api, build = self._api, self._api.VisualIndex.BuildOptions()
        each = max(1, _WORDS * _FEATURES_PER_WORD // len(images))
        sampled = [database.read_descriptors(image).data[:each] for image in images]
        features = np.concatenate(sampled).astype(np.float32)
        build.num_visual_words = min(_WORDS, max(1, len(features) // _FEATURES_PER_WORD))
        build.num_rounds, build.num_iterations, build.num_threads = 1, 10, self._threads
        index = api.VisualIndex.create(128, 64)
        index.build(build, api.FeatureDescriptorsFloat(api.FeatureExtractorType.SIFT, features))
        index.write(str(words))


def _hold_rig(options: Any, prefix: str) -> None:
    for held in ("focal_length", "principal_point", "extra_params", "sensor_from_rig"):
        setattr(options, f"{prefix}{held}", False)


def find_features(image: UInt8, most: float) -> tuple[Float32, UInt8]:
    """Find SIFT features of an image (H, W): places (N, 4) as COLMAP has them, RootSIFT (N, 128).

    Ref: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004; Arandjelović,
    Zisserman, "Three things everyone should know to improve object retrieval", CVPR 2012.
    """
    height, width = image.shape
    zoom = min(1.0, math.sqrt(most / image.size))
    size = (max(1, round(zoom * width)), max(1, round(zoom * height)))
    small = image if zoom == 1.0 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT.create(_FEATURES, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(small, None)
    if not keypoints:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    uv = (np.asarray(cv2.KeyPoint.convert(keypoints), np.float32) + 0.5) * np.divide(
        (width, height), size
    )
    shapes = [(point.size / 2.0 / zoom, math.radians(point.angle)) for point in keypoints]
    ratios = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1.0)
    root = np.rint(512.0 * np.sqrt(ratios)).clip(0, 255)
    return np.hstack([uv, shapes]).astype(np.float32), root.astype(np.uint8)


def _name(pair: int, *, right: bool = False) -> str:
    return f"{_RIGHT if right else _LEFT}/{pair:08d}"


def _number(name: str) -> int:
    return int(name.rpartition("/")[2])


def _read_model(model: Any, camera: RectifiedCamera) -> Model:
    posed = {
        _number(image.name): image
        for image in model.images.values()
        if image.has_pose and image.name.startswith(_LEFT)
    }
    frames = np.array(sorted(posed), np.int64)
    T_world_camera = np.tile(np.eye(4), (len(frames), 1, 1))
    error_px = float(model.compute_mean_reprojection_error())
    points, sigmas = np.zeros(len(frames), np.int64), np.full((len(frames), 2), np.nan)
    for at, number in enumerate(frames.tolist()):
        image = posed[number]
        T_world_camera[at, :3] = image.cam_from_world().inverse().matrix()
        seen = [point.point3D_id for point in image.points2D if point.has_point3D()]
        xyz = np.array([model.points3D[key].xyz for key in seen]).reshape(-1, 3)
        points[at] = len(xyz)
        sigmas[at] = _pose_sigmas(apply(invert(T_world_camera[at]), xyz), camera, error_px)
    based = invert(T_world_camera[0]) @ T_world_camera if len(frames) else T_world_camera
    return Model(frames, based, points, sigmas, error_px)


def _pose_sigmas(xyz: Float64, camera: RectifiedCamera, error_px: float) -> Float64:
    """Return standard deviations (2,) of a pose that points (N, 3) fix: metres and degrees."""
    x, y, z = xyz[xyz[:, 2] > 0].T
    zero = np.zeros_like(z)
    # How both coordinates of a pixel follow a small motion of the camera, and a small rotation.
    across = np.stack([1 / z, zero, -x / z**2, -x * y / z**2, 1 + (x / z) ** 2, -y / z], axis=1)
    down = np.stack([zero, 1 / z, -y / z**2, -1 - (y / z) ** 2, x * y / z**2, x / z], axis=1)
    J = camera.focal_px * np.concatenate([across, down])
    if np.linalg.matrix_rank(J) < 6:
        return np.full(2, np.nan)
    variances = error_px**2 * np.diag(np.linalg.inv(J.T @ J))
    return np.array([math.sqrt(variances[:3].sum()), math.degrees(math.sqrt(variances[3:].sum()))])


def _apart(models: Sequence[Model]) -> tuple[Model, ...]:
    """Return models without the pairs that a larger one has; the rest of one stays if it is two."""
    taken, kept = set[int](), list[Model]()
    for model in models:
        new = np.array([frame not in taken for frame in model.frames.tolist()], np.bool_)
        if new.sum() < 2:
            continue
        taken.update(model.frames.tolist())
        poses = model.T_world_camera[new]
        based = invert(poses[0]) @ poses
        parts = (model.frames[new], based, model.points[new], model.sigmas[new])
        kept.append(Model(*parts, model.reprojection_px))
    return tuple(kept)


@dataclass(frozen=True, eq=False)
class Model:
    """Pairs whose poses beside each other are known."""

    frames: Int64  # (M,), their numbers in the source, ascending
    T_world_camera: Float64  # (M, 4, 4), of the rectified left camera; the first is the identity
    points: Int64  # (M,), points of the model that the left image shows
    # (M, 2), standard deviations of position (metres) and rotation (degrees), given the points
    sigmas: Float64
    reprojection_px: float  # mean error of all features


@dataclass(frozen=True)
class SfmFigures(Figures):
    """How many pairs structure from motion placed, and how well."""

    pairs: int
    registered: int  # in the largest model
    models: Sequence[int]  # pairs in each
    reprojection_px: float  # mean error in the largest


@dataclass(frozen=True, eq=False)
class FoundPoses:
    """What structure from motion found of the pairs of a source."""

    pairs: int  # number of pairs of the source
    models: tuple[Model, ...]  # the largest first; no pair is in two of them

    def figures(self) -> SfmFigures:
        sizes = [len(model.frames) for model in self.models]
        return SfmFigures(self.pairs, sizes[0], sizes, self.models[0].reprojection_px)

    def warnings(self) -> list[str]:
        """Return what the user should know, the most important first."""
        largest, *others = self.models
        missing = self.pairs - len(largest.frames)
        if not missing:
            return []
        apart = "; ".join(
            f"{counted(len(one.frames), 'pair')} among themselves "
            f"({name_frames(one.frames.tolist())})"
            for one in others
        )
        what = f"{missing} of {counted(self.pairs, 'pair')} could not be placed beside the others"
        return [f"{what}, and are not in the map{f'; placed are {apart}' if apart else ''}"]


class FoundOdometry:
    """An odometry whose poses are those that structure from motion found; the largest model counts.

    Pairs that are not in it get the pose of one before, and are not to be trusted.

    Args:
        found: What was found; None = comes with `restore`.
    """

    def __init__(self, found: FoundPoses | None = None) -> None:
        self._found = found
        self._next = 0

    @property
    def found(self) -> FoundPoses:
        if self._found is None:
            raise RegistrationError("structure from motion has found nothing yet")
        return self._found

    def register(self, frame: OdometryFrame) -> OdometryResult:
        model, index = self.found.models[0], self._next
        self._next += 1
        at = max(0, int(np.searchsorted(model.frames, index, side="right")) - 1)
        T_world_camera = model.T_world_camera[at]
        if model.frames[at] != index:
            notes = ("structure from motion could not place it",)
            return OdometryResult(T_world_camera, OdometryHealth(False, skipped=True, notes=notes))
        points, (sigma_m, sigma_deg) = int(model.points[at]), model.sigmas[at].tolist()
        health = OdometryHealth(
            tracks=points, inliers=points, sigma_m=sigma_m, sigma_deg=sigma_deg,
            reprojection_px=model.reprojection_px,
        )  # fmt: skip
        return OdometryResult(T_world_camera, health)

    def state(self) -> dict[str, Any]:
        models = {str(number): vars(model) for number, model in enumerate(self.found.models)}
        return {"next": self._next, "pairs": self.found.pairs, "models": models}

    def restore(self, state: dict[str, Any]) -> None:
        models = tuple(Model(**state["models"][key]) for key in sorted(state["models"], key=int))
        self._found, self._next = FoundPoses(int(state["pairs"]), models), int(state["next"])


def check_sfm(source: StereoSource) -> None:
    """Refuse what structure from motion cannot work with, and say which package is missing."""
    check_source(source, stereo=True)
    load_colmap()
    if source.live:
        what = "structure from motion needs all pairs before it begins"
        raise SettingsError(what, where=source.name, hint="record the drive, then recon map it")


@dataclass(frozen=True)
class SfmOptions:
    """How the poses of a source are found."""

    rectification: RectificationSettings
    folder: Path | None = None  # where temporary files may be; None = where the system has them
    threads: int = 1
    limit_mb: float | None = None  # memory
    stopwatch: Stopwatch = field(default_factory=Stopwatch)


def find_poses(source: StereoSource, options: SfmOptions) -> FoundPoses:
    """Find the poses of all pairs of a source, whatever their order.

    Raises:
        RegistrationError: No two pairs can be placed beside each other.
        SettingsError: The source is live.
        MissingDependencyError: The extra ``sfm`` is not installed.
    """
    check_sfm(source)
    stage = options.stopwatch.stage
    try:
        with tempfile.TemporaryDirectory(prefix="sfm-", dir=options.folder) as folder:
            rectifier = Rectifier(source.calibration, options.rectification)
            work = Colmap(rectifier.camera, Path(folder), options.threads, options.limit_mb)
            with stage("sfm_features"):
                work.add_features(map(rectifier.rectify, source.frames()))
            with stage("sfm_match"):
                work.match(len(source))
            with stage("sfm_map"):
                models = work.map()
    except (RuntimeError, ValueError, IndexError) as error:  # those of C++
        what, hint = "structure from motion failed", "try --odometry visual"
        raise RegistrationError(what, where=source.name, got=error, hint=hint) from error
    if not models:
        raise RegistrationError(
            "structure from motion found no two pairs that see the same",
            where=source.name,
            got=counted(len(source), "pair"),
            hint="take pairs that overlap by half; recon pair makes a cloud of a single one",
        )
    return FoundPoses(len(source), models)
