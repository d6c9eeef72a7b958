"""A network in an ONNX file, run by onnxruntime: what it takes, in tiles if images are large.

It has to find the disparity of a rendered pair before it is believed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from recon.core.errors import FormatError, MatchingError, require
from recon.core.values.arrays import Float32, UInt8

LARGEST_PX: Final = 10_000  # length of an image that is matched
#: What files begin with that people save instead of a network.
_MISTAKEN: Final = {
    b"version https://git-lfs": ("a pointer of git-lfs", "fetch the file itself: git lfs pull"),
    b"<": ("a web page", "the address is that of a page, not of the file: download it there"),
    b"PK\x03\x04": ("a zip archive or PyTorch weights", "unpack or export it first"),
    b"\x1f\x8b": ("an archive (gzip)", "unpack it first"),
}


class OnnxNetwork:
    """A loaded network, run on the CPU; ``threads`` per operator, None = onnxruntime's default.

    It is ended after ``limit_s`` seconds: a file from elsewhere may have a loop without an end.

    Attributes:
        stacked: Whether one input takes both images, one behind the other: (1, 2·C, H, W).
        channels: Those of one image; 3 where the network leaves them free.
        size: Width and height of the images that it takes; None = any.
        layout: The number of inputs and their channels, in words.
    """

    def __init__(self, path: Path, threads: int | None = None, limit_s: float = 600.0) -> None:
        runtime = require("onnxruntime", extra="onnx")
        if not path.is_file():
            raise FormatError("file does not exist", where=path, expected="an ONNX network")
        with path.open("rb") as file:
            start = file.read(64).lstrip(b"\xef\xbb\xbf \r\n\t")
        for beginning, (got, hint) in _MISTAKEN.items():
            if start.startswith(beginning):
                expected = "an ONNX network"
                raise FormatError(
                    "not a network", where=path, got=got, expected=expected, hint=hint
                )
        self._path, self._limit_s, self._how = path, limit_s, runtime.RunOptions
        # The exceptions of onnxruntime have no common base class.
        state = vars(runtime.capi.onnxruntime_pybind11_state).values()
        own = [kind for kind in state if isinstance(kind, type) and issubclass(kind, Exception)]
        self._errors: tuple[type[Exception], ...] = (*own, RuntimeError, ValueError, TypeError)
        options = runtime.SessionOptions()
        options.intra_op_num_threads = threads or 0
        options.log_severity_level = 4  # fatal only: lesser errors arrive as exceptions
        try:
            self._session = runtime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except self._errors as error:
            what = "onnxruntime cannot load the network"
            raise FormatError(what, where=path, got=_first_line(error)) from error
        self._read_inputs()

    def _read_inputs(self) -> None:
        inputs = self._session.get_inputs()
        if not inputs:
            raise FormatError("the network has no input", where=self._path, expected="two images")
        shape = [length if isinstance(length, int) else None for length in inputs[0].shape]
        if not all(1 <= length <= LARGEST_PX for length in shape if length is not None):
            got, expected = "x".join(map(str, inputs[0].shape)), f"lengths of 1 to {LARGEST_PX}"
            what = "the network does not take images"
            raise FormatError(what, where=self._path, got=got, expected=expected)
        channels, height, width = shape[1:] if len(shape) == 4 else (None, None, None)
        self.stacked = len(inputs) == 1
        self.channels: int = max(1, channels // (1 + self.stacked)) if channels else 3
        self.size = None if width is None or height is None else (width, height)
        of, s = (self.channels * (1 + self.stacked), "" if self.stacked else "s")
        self.layout = f"{len(inputs)} input{s} of {of} channel{'s' if of > 1 else ''}"

    def run(self, inputs: Sequence[Float32]) -> list[Float32]:
        """Run the network once, from float32 arrays in the order of its inputs."""
        wanted = self._session.get_inputs()
        if len(wanted) != len(inputs):
            what, names = "the network has a different number of inputs", [w.name for w in wanted]
            got = f"{len(wanted)}: {', '.join(names)}"
            raise MatchingError(what, where=self._path, got=got, expected=str(len(inputs)))
        feed = {one.name: np.ascontiguousarray(x) for one, x in zip(wanted, inputs, strict=True)}
        try:
            return [np.asarray(output, dtype=np.float32) for output in self._outputs(feed)]
        except self._errors as error:
            what, got = "the network cannot process these images", _first_line(error)
            hint = "check the size that it expects: matching.onnx.size_px"
            raise MatchingError(what, where=self._path, got=got, hint=hint) from error

    def _outputs(self, feed: dict[str, Float32]) -> list[Any]:
        """Run the network in a thread, so that Ctrl-C and the limit end it."""
        options = self._how()
        with ThreadPoolExecutor(1) as pool:
            running = pool.submit(self._session.run, None, feed, options)
            try:
                wait([running], self._limit_s)
                late = not running.done()
            finally:
                options.terminate = True
        if late:
            what, got = "the network does not come to an end", f"{self._limit_s:g} s"
            hint = "give it smaller images: matching.onnx.size_px"
            raise MatchingError(what, where=self._path, got=got, hint=hint)
        return list(running.result())


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__


#: Pixels around a tile that a network sees with it. Beyond, nothing should decide a disparity.
_CONTEXT_PX: Final = 96


def match_in_tiles(
    match: Callable[[UInt8, UInt8], Float32],
    views: tuple[UInt8, UInt8],
    reach_px: int,
    most_px: int,
    multiple_px: int,
) -> Float32:
    """Return the disparity of two images, float32 (H, W), matched in tiles if they are large.

    Tiles begin at multiples of ``multiple_px``, so that a network which halves its images sees the
    same pixels together as in the whole image, and are cut where they meet, not blended: a mean of
    two depths is neither.

    Args:
        match: Gives the disparity of two images of one size.
        views: uint8 (H, W) or (H, W, 3), with H and W multiples of ``multiple_px``.
        reach_px: Largest disparity, which each tile sees to its left.
        most_px: Pixels of a tile with what is around it, unless that alone is more.
        multiple_px: Of the network's sizes.
    """
    height, width = views[0].shape[:2]
    if height * width <= most_px:
        return match(*views)

    def even(length: float) -> int:
        return multiple_px * -(-int(length) // multiple_px)

    around = even(_CONTEXT_PX)
    before = around + even(reach_px)
    # As wide as possible: disparities reach along rows.
    wide = min(width, max(even(most_px / (4 * around)), before + 2 * around))
    tall = min(height, max(even(most_px / wide - multiple_px + 1), 3 * around))
    values = np.empty((height, width), np.float32)
    for top, rows in _spans(height, tall, around, around):
        for left, columns in _spans(width, wide, before, around):
            ends = rows.stop + around, columns.stop + around
            seen = np.s_[top : ends[0], left : ends[1]]
            found = match(views[0][seen], views[1][seen])
            kept = np.s_[rows.start - top : rows.stop - top, columns.start - left :]
            values[rows, columns] = found[kept][:, : columns.stop - columns.start]
    return values


def _spans(length: int, most: int, before: int, after: int) -> Iterator[tuple[int, slice]]:
    """Yield where each tile begins to see, and what of its result is kept."""
    first = 0
    while first < length:
        start = max(first - before, 0)
        last = length if start + most >= length else start + most - after
        yield start, slice(first, last)
        first = last


_SIZE: Final = (384, 256)  # where the network leaves it free
_NEAREST: Final = 0.05  # disparity of the pixel that is nearest, of the width
_GRAINS_PX: Final = (0.8, 2.5, 8.0)  # blur of the noise that the texture is the sum of
# Of a textured plane even a network that matches at a quarter of the size finds its disparity to a
# fraction of a pixel; a network that does not is fed or read in the wrong way.
_LIMIT_PX: Final = 1.0


def rendered_pair(size: tuple[int, int] = _SIZE) -> tuple[UInt8, UInt8, Float32]:
    """Return left and right view of a slanted, textured plane, and its disparity.

    uint8 (H, W) twice and float32 (H, W); 2 to 5 % of the width.
    """
    width, height = size
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    ratio = 0.4 + 0.4 * rows / height + 0.2 * columns / width
    disparity = (_NEAREST * width * ratio).astype(np.float32)
    margin = int(np.ceil(_NEAREST * width)) + 2
    random = np.random.default_rng(0)
    texture = np.zeros((height, width + margin))
    for grain in _GRAINS_PX:
        noise = cv2.GaussianBlur(random.normal(size=texture.shape), (0, 0), grain)
        texture += noise / noise.std()
    levels = np.clip(128 + 30 * texture, 0, 255).astype(np.float32)
    left = cv2.remap(levels, columns + margin - disparity, rows, cv2.INTER_CUBIC)
    left = np.clip(np.rint(left), 0, 255).astype(np.uint8)
    return left, np.rint(levels[:, margin:]).astype(np.uint8), disparity


def check_network(
    match: Callable[[UInt8, UInt8], Float32],
    size: tuple[int, int] | None,
    output_scale: float,
    path: Path,
) -> None:
    """Let a network match a rendered pair once.

    Raises:
        MatchingError: It does not find the disparity; the line says what it finds instead.
    """
    left, right, truth = rendered_pair(size or _SIZE)
    height, width = truth.shape
    # Not near the border, nor where the right view does not show the plane.
    inner = np.s_[height // 8 : -height // 8, int(2 * _NEAREST * width) : -width // 16]
    found, truth = match(left, right)[inner], truth[inner]
    if not np.isfinite(found).mean() > 0.5:
        raise _failure(path, "no finite number", "check mean and std, and the output")
    found, truth = (one[np.isfinite(found)] for one in (found, truth))
    error = float(np.median(np.abs(found - truth)))
    if error <= _LIMIT_PX:
        return
    if np.ptp(found) < 1e-3 * max(1e-6, float(np.abs(found).max())):
        raise _failure(path, f"{float(found[0]):.4g} everywhere", "check mean, std and output")
    ratio = float(np.median(found / truth))
    if ratio and float(np.median(np.abs(found / ratio - truth))) <= _LIMIT_PX:
        scale = f"--set matching.onnx.output_scale={output_scale / ratio:.4g}"
        raise _failure(path, f"{ratio:.4g} times the disparity", scale)
    what = f"a median error of {error:.3g} px"
    raise _failure(path, what, "check preset, mean, std, output, and which input is left")


def _failure(path: Path, got: str, hint: str) -> MatchingError:
    return MatchingError(
        "the network does not find the disparity of a rendered plane",
        where=path,
        got=got,
        hint=f"{hint} (self_test=false lets it pass)",
    )
