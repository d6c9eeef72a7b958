"""The seed paper's experiments 2 to 4, as printed and corrected, on three Middlebury scenes."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import CalibrationError, MatchingError, SourceError
from recon.core.summary import Figures, Rows, RunSummary
from recon.core.text import counted
from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    PointCloud,
    Reason,
    Rectified,
    RectifiedCamera,
    RectifiedPair,
    StereoPair,
)
from recon.core.values.arrays import Float32
from recon.core.values.camera import depth_from_disparity
from recon.evaluation.disparity import evaluate_disparity
from recon.io.middlebury import read_middlebury_calib, read_middlebury_scene
from recon.stereo.frame import CloudSettings, FrameReconstructor, StereoSettings, back_project
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.sad import SadMatcher
from recon.stereo.match.search import usual_ndisp
from recon.stereo.rectify.rectifier import Rectifier, to_grey

# Scene of each experiment, identified by Table 1: docs/walk-research.md.
EXPERIMENTS: Final[Mapping[int, str]] = {2: "ArtL", 3: "Jadeplant", 4: "Pipes"}
CORRECTED, ABSOLUTE, AS_PRINTED = "corrected", "absolute", "as_printed"
TITLES: Final[Mapping[str, str]] = {
    CORRECTED: "corrected",
    ABSOLUTE: "as printed, but absolute differences",
    AS_PRINTED: "as printed",
}
BAD_PX: Final = 1.0  # disparity error above which a pixel counts as wrong
_SCENES: Final = Path("middlebury", "MiddEval3", "trainingQ")
_WHERE: Final = "name the folder MiddEval3/trainingQ of the Middlebury benchmark"
_SIGMA_PX: Final = 1 / math.sqrt(12)  # of what is rounded to whole pixels
# Keeps every point of the printed method, regardless of range and uncertainty.
_EVERY_POINT: Final = CloudSettings(min_range_m=0.0, max_range_m=None, max_relative_sigma=None)
PATCHES_PX: Final = tuple(range(3, 22, 2))  # of patches, and of windows of `sad`, to compare
_PATCH_PX: Final = 11  # of the printed method; the paper does not give it


@dataclass(frozen=True, eq=False)
class Experiment:
    """Input of one experiment: its scene, the truth of which may be missing, and its files."""

    number: int
    scene: str
    pair: StereoPair
    camera: RectifiedCamera
    truth: DisparityTruth | None
    files: tuple[Path, ...]


@dataclass(frozen=True, kw_only=True)
class DepthFigures(Figures):
    """Depths beside the true ones, at pixels that both cameras see."""

    median_m: float
    true_median_m: float
    median_error_percent: float  # median of the absolute error, per cent of the true depth
    median_ratio: float  # of depth and true depth
    pixels: int


@dataclass(frozen=True, kw_only=True)
class MethodFigures(Figures):
    """What a method finds in a scene; None = there is no ground truth."""

    valid_percent: float  # of the pixels, those with a value
    points: int
    depth_median_m: float | None
    disparity: DisparityMetrics | None
    depth: DepthFigures | None

    @property
    def text(self) -> str:
        """The most important figures in a line."""
        parts = [f"{self.valid_percent:.1f} % of the pixels have a value"]
        if self.disparity is not None:
            parts.append(f"{self.disparity.bad[1.0]:.1f} % off by more than 1 px")
        if self.depth is not None:
            parts.append(f"median depth error {self.depth.median_error_percent:.2f} %")
        return ", ".join(parts)


@dataclass(frozen=True)
class PatchFigures(Figures):
    """Pixels with a value, wrong and right, in per cent, and the mean error by size of a patch."""

    patch_px: int
    valid_percent: float
    bad_percent: float | None
    right_percent: float | None
    avgerr_px: float | None


@dataclass(frozen=True, kw_only=True)
class ExperimentFigures(Figures):
    """One experiment: each method, alone and with all patch sizes."""

    scene: str
    width_px: int
    height_px: int
    methods: Mapping[str, MethodFigures]
    patches: Mapping[str, Sequence[PatchFigures]]


@dataclass(frozen=True, kw_only=True)
class PaperSummary(RunSummary):
    """What `recon paper` found, by number of the experiment."""

    as_printed: bool
    table_1: Sequence[Mapping[str, Any]]
    experiments: Mapping[str, ExperimentFigures]

    def rows(self) -> Rows:
        methods = dict.fromkeys(name for one in self.experiments.values() for name in one.methods)
        corrected = [
            (one.scene, f"{found.text}")
            for one in self.experiments.values()
            if (found := one.methods.get(CORRECTED)) is not None
        ]
        return [
            (f"{counted(len(self.experiments), 'experiment')} by {', '.join(methods)}",),
            *self.folder_row(),
            *corrected[:3],
            *self.cost_row(),
            ("next", self.open_report()),
        ]


@dataclass(frozen=True, eq=False)
class MethodResult:
    """Result of one method on one experiment."""

    method: str  # a key of `TITLES`
    pair: Rectified  # the grey images, with the camera that the method assumes
    disparity: Disparity
    depth_m: Float32  # (H, W), metres; NaN = unknown
    cloud: PointCloud  # in camera axes
    figures: MethodFigures


@dataclass(frozen=True)
class PrintedMatcher:
    """Block matching as the paper prints it: whole disparities, no check, plain numpy.

    A pixel has no value only where no patch lies within both images. Every other pixel keeps
    its minimum, however doubtful: confidence 1 says that nothing was asked, not that it is right.

    Ref: Eq. 9-10 of the seed paper, see docs/walk-research.md.
    """

    patch_px: int  # edge of the patch; odd
    signed: bool  # sum differences with their signs, as printed; else absolute ones, as SAD means

    def match(self, pair: RectifiedPair) -> Disparity:
        """Return the disparities with the smallest sum, as far as the camera says or a tenth."""
        shape, size = pair.left.shape, self.patch_px
        if size > min(shape):
            what, expected = "patch is larger than the image", f"at most {min(shape)} px"
            raise MatchingError(what, got=f"{size} px", expected=expected)
        values = np.full(shape, np.nan, dtype=np.float32)
        inside = self._smallest_sums(pair)
        values[size // 2 :, size // 2 :][: inside.shape[0], : inside.shape[1]] = inside
        known = np.isfinite(values)
        return Disparity(
            values=values,
            confidence=known.astype(np.float32),
            sigma_px=np.where(known, np.float32(_SIGMA_PX), np.float32(np.nan)),
            reason=np.where(known, np.uint8(Reason.VALID), np.uint8(Reason.BORDER)),
        )

    def _smallest_sums(self, pair: RectifiedPair) -> Float32:
        """Return float32, the disparity of each pixel whose patch lies within the left image."""
        left, right = pair.left.astype(np.int32), pair.right.astype(np.int32)
        size = (left.shape[0] - self.patch_px + 1, left.shape[1] - self.patch_px + 1)
        least, best = np.full(size, np.iinfo(np.int64).max), np.zeros(size, dtype=np.float32)
        for d in range(min(pair.camera.ndisp or usual_ndisp(pair.camera.width_px), size[1])):
            difference = left[:, d:] - right[:, : right.shape[1] - d]
            compared = (difference if self.signed else np.abs(difference)).astype(np.int64)
            # Sums over all patches, by an integral image.
            n, table = self.patch_px, np.pad(compared, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
            sums = table[n:, n:] - table[:-n, n:] - table[n:, :-n] + table[:-n, :-n]
            # Strictly less: of equal sums the smallest disparity wins.
            better = sums < least[:, d:]
            least[:, d:][better] = sums[better]
            best[:, d:][better] = d
        return best


def read_experiments(folder: Path | None = None) -> list[Experiment]:
    """Read the three scenes; None = those of MiddEval3 in the folder that ``RECON_DATA`` names."""
    if folder is None and not os.environ.get("RECON_DATA"):
        what = "no folder of scenes is given, and RECON_DATA is not set"
        expected = f"a folder with {', '.join(EXPERIMENTS.values())}"
        raise SourceError(what, expected=expected, hint=_WHERE)
    folder = folder or Path(os.environ["RECON_DATA"]) / _SCENES
    if missing := [scene for scene in EXPERIMENTS.values() if not (folder / scene).is_dir()]:
        got = f"no folder {', '.join(missing)}"
        raise SourceError("scenes of the paper are missing", where=folder, got=got, hint=_WHERE)
    experiments = []
    for number, name in EXPERIMENTS.items():
        scene = read_middlebury_scene(folder / name)
        calib = read_middlebury_calib(folder / name / "calib.txt")
        # The file rounds doffs and the principal points independently; doffs defines depth.
        doffs_px = calib.camera.doffs_px if calib.doffs_px is None else calib.doffs_px
        camera = replace(calib.camera, cx_right_px=calib.camera.cx_px + doffs_px)
        files = tuple(sorted(path for path in (folder / name).iterdir() if path.is_file()))
        found = Experiment(number, scene.name, scene.pair, camera, scene.truth, files)
        experiments.append(found)
    return experiments


def camera_of_table_1(camera: RectifiedCamera) -> RectifiedCamera:
    """Return the camera of Table 1: ``doffs`` is the focal length, and no offset is added to d."""
    if camera.doffs_px <= 0:
        what, got = "doffs cannot be used as a focal length", f"{camera.doffs_px:g} px"
        raise CalibrationError(what, got=got, expected="> 0 px")
    return replace(camera, focal_px=camera.doffs_px, cx_right_px=camera.cx_px)


def table_1_row(experiment: Experiment) -> dict[str, Any]:
    """Return a row of Table 1 as printed and corrected, and the error that it makes by itself."""
    camera, truth, error = experiment.camera, experiment.truth, None
    if truth is not None and camera.doffs_px > 0:
        depth_m = depth_from_disparity(truth.values, camera_of_table_1(camera))
        compared = compare_depth(depth_m, truth, camera)
        error = None if compared is None else compared.median_error_percent
    both = {"baseline_mm": round(1000 * camera.baseline_m, 6), "ndisp": camera.ndisp}
    doffs_px = round(camera.doffs_px, 6)
    return {
        "experiment": experiment.number,
        "scene": experiment.scene,
        "printed": {"focal_length": doffs_px, **both},
        "corrected": {"focal_px": camera.focal_px, "doffs_px": doffs_px, **both},
        "depth_error_of_printed_percent": error,
    }


def apply_method(
    method: str, experiment: Experiment, config: StereoSettings, threads: int | None = None
) -> MethodResult:
    """Reconstruct one experiment by one method.

    ``corrected`` is our matcher with the scene's calibration; ``absolute`` and ``as_printed`` find
    integer disparities in Eq. 6 grey images, and use Table 1's focal length as printed.
    """
    if method == CORRECTED:
        rebuilt = FrameReconstructor(experiment.camera, config, threads=threads)
        frame = rebuilt.reconstruct(experiment.pair)
        pair, disparity, cloud = frame.pair, frame.disparity.only_measured(), frame.cloud
    else:
        pair = _printed_pair(experiment)
        disparity = PrintedMatcher(_PATCH_PX, method == AS_PRINTED).match(pair)
        pair = replace(pair, camera=camera_of_table_1(pair.camera))
        cloud = back_project(disparity, pair, _EVERY_POINT, normals=False)
    depth_m, truth = depth_from_disparity(disparity.values, pair.camera), experiment.truth
    known_m = depth_m[np.isfinite(depth_m)]
    figures = MethodFigures(
        valid_percent=100.0 * float(disparity.valid.mean()),
        points=len(cloud),
        depth_median_m=float(np.median(known_m)) if len(known_m) else None,
        disparity=None if truth is None else evaluate_disparity(disparity, truth),
        depth=None if truth is None else compare_depth(depth_m, truth, experiment.camera),
    )
    return MethodResult(method, pair, disparity, depth_m, cloud, figures)


def try_patches(
    method: str, experiment: Experiment, config: StereoSettings, threads: int | None = None
) -> list[PatchFigures]:
    """Run a method with patches of each size; ``corrected`` uses the matcher `sad`."""
    if method == CORRECTED:
        pair = Rectifier(experiment.camera, config.rectification).rectify(experiment.pair)
    else:
        pair = _printed_pair(experiment)
    figures = []
    for patch_px in PATCHES_PX:
        if patch_px <= min(pair.left.shape):
            matcher: Matcher = PrintedMatcher(patch_px, method == AS_PRINTED)
            if method == CORRECTED:
                own = config.matching.model_copy(update={"window_px": patch_px})
                matcher = SadMatcher(own, threads)
            figures.append(_patch_figures(patch_px, matcher.match(pair), experiment.truth))
    return figures


def compare_depth(
    depth_m: Float32, truth: DisparityTruth, camera: RectifiedCamera
) -> DepthFigures | None:
    """Compare depths (H, W) with the truth at pixels seen by both cameras; None = none has both."""
    true_m = depth_from_disparity(truth.values, camera)
    both = np.isfinite(depth_m) & np.isfinite(true_m) & truth.nonocc
    if not both.any():
        return None
    found, true = depth_m[both].astype(np.float64), true_m[both].astype(np.float64)
    return DepthFigures(
        median_m=float(np.median(found)),
        true_median_m=float(np.median(true)),
        median_error_percent=100 * float(np.median(np.abs(found - true) / true)),
        median_ratio=float(np.median(found / true)),
        pixels=int(both.sum()),
    )


def _printed_pair(experiment: Experiment) -> RectifiedPair:
    pair, rectifier = experiment.pair, Rectifier(experiment.camera)
    left, right = (to_grey(image, "paper") for image in rectifier.warp(pair))
    return replace(rectifier.rectify(pair), left=left, right=right)


def _patch_figures(patch_px: int, found: Disparity, truth: DisparityTruth | None) -> PatchFigures:
    """Return fractions of pixels with a value, wrong and right, and the mean error in pixels."""
    bad = right = error = None
    if truth is not None:
        metrics = evaluate_disparity(found, truth, (BAD_PX,))
        bad, error = metrics.bad[BAD_PX], metrics.avgerr_px
        right = 100 - bad - metrics.invalid
    valid_percent = 100 * float(found.valid.mean())
    return PatchFigures(patch_px, valid_percent, bad, right, error)
