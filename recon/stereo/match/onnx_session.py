"""Adapter of onnxruntime (extra ``onnx``) for ONNX networks: arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from recon.core.errors import FormatError, MatchingError
from recon.core.optional import require
from recon.core.values.arrays import Float32


class OnnxNetwork:
    """A loaded network, run on the CPU.

    Args:
        path: An ``.onnx`` file.
        threads: Threads per operator; None = onnxruntime's default.
    """

    def __init__(self, path: Path, threads: int | None = None) -> None:
        runtime = require("onnxruntime", extra="onnx")
        if not path.is_file():
            raise FormatError("file does not exist", where=path, expected="an ONNX network")
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

    def run(self, inputs: Sequence[Float32]) -> list[Float32]:
        """Run the network once.

        Args:
            inputs: float32 arrays, in the order of the network's inputs.

        Returns:
            The outputs, in the order of the network.
        """
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


def _errors_of(runtime: Any) -> tuple[type[Exception], ...]:
    """Return exceptions that onnxruntime raises: its own have no common base class."""
    state = vars(runtime.capi.onnxruntime_pybind11_state).values()
    own = [kind for kind in state if isinstance(kind, type) and issubclass(kind, Exception)]
    return (*own, RuntimeError, ValueError, TypeError)


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
