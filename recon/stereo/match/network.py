"""A network in an ONNX file, run by onnxruntime: what it takes, and that it is one at all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError, MatchingError, require
from recon.core.values.arrays import Float32

#: What files begin with that people save instead of a network.
_MISTAKEN: Final = {
    b"version https://git-lfs": ("a pointer of git-lfs", "fetch the file itself: git lfs pull"),
    b"<": ("a web page", "the address is that of a page, not of the file: download it there"),
    b"PK\x03\x04": ("a zip archive or PyTorch weights", "unpack or export it first"),
    b"\x1f\x8b": ("an archive (gzip)", "unpack it first"),
}


class OnnxNetwork:
    """A loaded network, run on the CPU; ``threads`` per operator, None = onnxruntime's default."""

    def __init__(self, path: Path, threads: int | None = None) -> None:
        runtime = require("onnxruntime", extra="onnx")
        if not path.is_file():
            raise FormatError("file does not exist", where=path, expected="an ONNX network")
        _refuse_mistaken(path)
        self._path = path
        self._errors = _errors_of(runtime)
        options = runtime.SessionOptions()
        options.intra_op_num_threads = threads or 0
        options.log_severity_level = 4  # fatal only: lesser errors arrive as exceptions
        try:
            self._session = runtime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except self._errors as error:
            raise FormatError(
                "onnxruntime cannot load the network", where=path, got=_first_line(error)
            ) from error

    @property
    def input_shapes(self) -> tuple[tuple[int | None, ...], ...]:
        """The shape of each input as the network declares it; None = a size that is free."""
        return tuple(
            tuple(length if isinstance(length, int) else None for length in one.shape)
            for one in self._session.get_inputs()
        )

    @property
    def stacked(self) -> bool:
        """Whether one input takes both images, one behind the other: (1, 2·C, H, W)."""
        return len(self._session.get_inputs()) == 1

    @property
    def channels(self) -> int:
        """The channels of one image; 3 where the network leaves them free."""
        first = self.input_shapes[0]
        channels = first[1] if len(first) == 4 else None
        if channels is None:
            return 3
        return max(1, channels // 2) if self.stacked else channels

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the images that it takes; None = any."""
        first = self.input_shapes[0]
        height, width = first[2:] if len(first) == 4 else (None, None)
        return None if width is None or height is None else (width, height)

    @property
    def layout(self) -> str:
        """What it takes, in words."""
        count = len(self._session.get_inputs())
        channels = self.channels * (2 if self.stacked else 1)
        return f"{count} input{'s'[: count != 1]} of {channels} channel{'s'[: channels != 1]}"

    def run(self, inputs: Sequence[Float32]) -> list[Float32]:
        """Run the network once, from float32 arrays in the order of its inputs."""
        wanted = self._session.get_inputs()
        if len(wanted) != len(inputs):
            raise MatchingError(
                "the network has a different number of inputs",
                where=self._path,
                got=f"{len(wanted)}: {', '.join(one.name for one in wanted)}",
                expected=str(len(inputs)),
            )
        feed = {one.name: np.ascontiguousarray(x) for one, x in zip(wanted, inputs, strict=True)}
        try:
            outputs = self._session.run(None, feed)
        except self._errors as error:
            raise MatchingError(
                "the network cannot process these images",
                where=self._path,
                got=_first_line(error),
                hint="check the size that it expects: matching.onnx.width_px and height_px",
            ) from error
        return [np.asarray(output, dtype=np.float32) for output in outputs]


def _refuse_mistaken(path: Path) -> None:
    with path.open("rb") as file:
        start = file.read(64).lstrip(b"\xef\xbb\xbf \r\n\t")
    for beginning, (what, hint) in _MISTAKEN.items():
        if start.startswith(beginning):
            raise FormatError(
                "not a network", where=path, got=what, expected="an ONNX network", hint=hint
            )


def _errors_of(runtime: Any) -> tuple[type[Exception], ...]:
    """Return exceptions that onnxruntime raises: its own have no common base class."""
    state = vars(runtime.capi.onnxruntime_pybind11_state).values()
    own = [kind for kind in state if isinstance(kind, type) and issubclass(kind, Exception)]
    return (*own, RuntimeError, ValueError, TypeError)


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
