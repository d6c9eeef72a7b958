"""Arrays that arrive in parts as one NumPy archive (``.npz``)."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from typing import IO, Any, Final
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
from numpy.typing import NDArray

from recon.io.atomic import atomic_path
from recon.io.files import StrPath

Arrays = Mapping[str, NDArray[Any]]
_LEVEL: Final = 1  # of compression: coordinates hardly get smaller with more


def write_npz(path: StrPath, parts: Iterable[Arrays], whole: Arrays) -> int:
    """Write arrays into one archive, atomically; returns the rows of the parts.

    Arrays of the same name in all ``parts`` (n, ...) become one, in a file beside until all have
    arrived, so that memory holds one part. Names that the first part lacks are not written.
    """
    rows, shapes = 0, {name: (array.dtype, array.shape) for name, array in whole.items()}
    with ExitStack() as stack:
        temporary = stack.enter_context(atomic_path(path))
        files: dict[str, IO[bytes]] = {}
        for part in parts:
            if not files:
                files = {
                    name: stack.enter_context(tempfile.TemporaryFile(dir=temporary.parent))
                    for name in part
                }
            for name, file in files.items():
                file.write(part[name].tobytes())
                shapes[name] = (part[name].dtype, part[name].shape[1:])
            rows += len(next(iter(part.values())))
        archive = stack.enter_context(
            ZipFile(temporary, "w", ZIP_DEFLATED, compresslevel=_LEVEL, allowZip64=True)
        )
        for name, (dtype, shape) in shapes.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                if name not in files:
                    np.lib.format.write_array(entry, whole[name], allow_pickle=False)
                    continue
                header = {"descr": dtype.str, "fortran_order": False, "shape": (rows, *shape)}
                np.lib.format.write_array_header_1_0(entry, header)
                files[name].seek(0)
                shutil.copyfileobj(files[name], entry)
        archive.close()
    return rows
