"""A network in an ONNX file, run by onnxruntime: what it takes, and that it is one at all."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError, MatchingError, require
from recon.core.values.arrays import Float32

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
        _refuse_mistaken(path)
        self._path, self._limit_s, self._how = path, limit_s, runtime.RunOptions
        self._errors = _errors_of(runtime)
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


def _refuse_mistaken(path: Path) -> None:
    with path.open("rb") as file:
        start = file.read(64).lstrip(b"\xef\xbb\xbf \r\n\t")
    for beginning, (what, hint) in _MISTAKEN.items():
        if start.startswith(beginning):
            how = {"got": what, "expected": "an ONNX network", "hint": hint}
            raise FormatError("not a network", where=path, **how)


def _errors_of(runtime: Any) -> tuple[type[Exception], ...]:
    """Return exceptions that onnxruntime raises: its own have no common base class."""
    state = vars(runtime.capi.onnxruntime_pybind11_state).values()
    own = [kind for kind in state if isinstance(kind, type) and issubclass(kind, Exception)]
    return (*own, RuntimeError, ValueError, TypeError)


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
