"""Ray files: round trips, and errors for damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import FormatError
from recon.core.values import RayCloud, RayGrain
from recon.io.rays import RayFile, RayWriter

GRAIN = RayGrain(0.1, 0.1 / 64, 25.0)
FIELDS = ("places", "sigma_m", "confidence", "count")


def _rays(seed: int, n: int) -> RayCloud:
    rng = np.random.default_rng(seed)
    return RayCloud(
        rng.integers(-(2**15), 2**15, (n, 3)).astype(np.int16),
        rng.uniform(0, 3, n).astype(np.float16),
        rng.integers(1, 256, n).astype(np.uint8),
        rng.integers(1, 256, n).astype(np.uint8),
        GRAIN.unit_m,
    )


def _write(path: Path, frames: list[RayCloud]) -> Path:
    writer = RayWriter(path, GRAIN)
    for frame in frames:
        writer.append(frame)
    writer.close()
    return path


def _assert_same(ours: list[RayCloud], theirs: list[RayCloud]) -> None:
    assert len(ours) == len(theirs)
    for one, other in zip(ours, theirs, strict=True):
        assert one.unit_m == other.unit_m
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_frames_are_read_as_they_were_written(tmp_path: Path) -> None:
    frames = [_rays(0, 100), _rays(1, 0), _rays(2, 7)]
    file = RayFile(_write(tmp_path / "rays.bin", frames))
    assert file.grain == GRAIN
    assert len(file) == 3
    _assert_same(list(file), frames)
    _assert_same(list(file), frames)  # again from the start


def test_a_file_without_frames_is_a_file(tmp_path: Path) -> None:
    file = RayFile(_write(tmp_path / "rays.bin", []))
    assert len(file) == 0
    assert list(file) == []


def test_writing_goes_on_from_where_it_was_and_forgets_the_rest(tmp_path: Path) -> None:
    path, frames = tmp_path / "rays.bin", [_rays(n, 10 + n) for n in range(4)]
    writer = RayWriter(path, GRAIN)
    writer.append(frames[0])
    size = writer.sync()
    assert path.stat().st_size == size
    writer.append(frames[3])
    writer.close()
    path.write_bytes(path.read_bytes()[:-5])  # killed while it wrote
    writer = RayWriter(path, GRAIN, size)
    writer.append(frames[1])
    writer.append(frames[2])
    writer.close()
    _assert_same(list(RayFile(path)), frames[:3])
    assert path.read_bytes() == _write(tmp_path / "unbroken.bin", frames[:3]).read_bytes()


def test_a_file_that_lost_what_was_written_cannot_be_gone_on_with(tmp_path: Path) -> None:
    path = _write(tmp_path / "rays.bin", [_rays(0, 10)])
    with pytest.raises(FormatError, match="missing"):
        RayWriter(path, GRAIN, path.stat().st_size + 1)
    with pytest.raises(FormatError, match="missing"):
        RayWriter(tmp_path / "none.bin", GRAIN, 40)


@pytest.mark.parametrize("cut", [1, 9, 60, 101])
def test_a_cut_file_is_told(tmp_path: Path, cut: int) -> None:
    path = _write(tmp_path / "rays.bin", [_rays(0, 10), _rays(1, 10)])
    path.write_bytes(path.read_bytes()[:-cut])
    with pytest.raises(FormatError, match="truncated or damaged"):
        list(RayFile(path))
    with pytest.raises(FormatError, match="truncated or damaged"):
        len(RayFile(path))


@pytest.mark.parametrize("place", [40, 47, 60, 150])
def test_a_flipped_bit_is_told(tmp_path: Path, place: int) -> None:
    path = _write(tmp_path / "rays.bin", [_rays(0, 10), _rays(1, 10)])
    content = bytearray(path.read_bytes())
    content[place] ^= 0x80
    path.write_bytes(content)
    with pytest.raises(FormatError, match="truncated or damaged"):
        list(RayFile(path))


@pytest.mark.parametrize("content", [b"", b"recon", b"no rays at all" * 10])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "rays.bin"
    path.write_bytes(content)
    with pytest.raises(FormatError, match="not a ray file"):
        RayFile(path)


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="does not exist"):
        RayFile(tmp_path / "none.bin")
