"""The OctoMap adapter: exact both ways, and no foreign errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.adapters.pyoctomap import KEY_LIMIT, decode_octomap, encode_octomap
from recon.errors import FormatError, MappingError


def test_read_only_arrays_are_encoded() -> None:
    keys, log_odds = np.array([[1, -2, 3]], np.int32), np.array([0.7], np.float32)
    keys.flags.writeable = log_odds.flags.writeable = False
    full, binary = encode_octomap(keys, log_odds, 0.1)
    assert full.startswith(b"# Octomap OcTree file")
    assert binary.startswith(b"# Octomap OcTree binary file")


def test_extreme_cells_and_log_odds_survive(tmp_path: Path) -> None:
    keys = np.array([[-KEY_LIMIT, 0, KEY_LIMIT - 1], [5, -6, 7]], np.int32)
    log_odds = np.array([-6.0, 6.0], np.float32)
    (tmp_path / "a.ot").write_bytes(encode_octomap(keys, log_odds, 0.05)[0])
    back, values, resolution = decode_octomap(tmp_path / "a.ot")
    assert dict(zip(map(tuple, back.tolist()), values.tolist(), strict=True)) == {
        (-KEY_LIMIT, 0, KEY_LIMIT - 1): -6.0,
        (5, -6, 7): 6.0,
    }
    assert resolution == pytest.approx(0.05)


def test_pruned_leaves_are_expanded(tmp_path: Path) -> None:
    keys = np.stack(np.unravel_index(np.arange(64), (4, 4, 4)), axis=1) - 4
    full, binary = encode_octomap(keys.astype(np.int32), np.full(64, 1.5, np.float32), 0.2)
    (tmp_path / "a.bt").write_bytes(binary)
    back, values, _ = decode_octomap(tmp_path / "a.bt")
    assert len(binary) < len(full)
    assert sorted(back.tolist()) == sorted(keys.tolist())
    assert (values > 0).all()


@pytest.mark.parametrize("cell", [-KEY_LIMIT - 1, KEY_LIMIT])
def test_a_map_too_large_for_octomap_is_refused(cell: int) -> None:
    with pytest.raises(MappingError, match="too large"):
        encode_octomap(np.array([[0, cell, 0]], np.int32), np.ones(1, np.float32), 0.2)


@pytest.mark.parametrize("kind", [0, 1])
@pytest.mark.parametrize("keep", [0.3, 0.6, 0.95])
def test_a_truncated_file_is_a_format_error(tmp_path: Path, kind: int, keep: float) -> None:
    rng = np.random.default_rng(0)
    keys = np.unique(rng.integers(-50, 50, (4000, 3)), axis=0).astype(np.int32)
    log_odds = rng.uniform(-2, 2, len(keys)).astype(np.float32)
    content = encode_octomap(keys, log_odds, 0.2)[kind]
    path = tmp_path / "cut"
    path.write_bytes(content[: int(len(content) * keep)])
    with pytest.raises(FormatError, match="truncated"):
        decode_octomap(path)


def test_a_header_without_a_tree_is_a_format_error(tmp_path: Path) -> None:
    (tmp_path / "a.ot").write_bytes(b"# Octomap OcTree file\n# cut\n")
    with pytest.raises(FormatError):
        decode_octomap(tmp_path / "a.ot")
