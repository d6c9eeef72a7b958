"""The OctoMap adapter reads a ``.bt`` written by pyoctomap, and raises only our errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyoctomap
import pytest

from recon.adapters.pyoctomap import decode_octomap
from recon.errors import FormatError


def _encode(keys: np.ndarray, log_odds: np.ndarray) -> bytes:
    """The content of a ``.bt`` file, by pyoctomap."""
    tree = pyoctomap.OcTree(0.2)
    for centre, value in zip(((keys + 0.5) * 0.2).tolist(), log_odds.tolist(), strict=True):
        tree.updateNode(centre, value, True)
    tree.updateInnerOccupancy()
    return bytes(tree.writeBinary())


def test_pruned_leaves_are_expanded(tmp_path: Path) -> None:
    keys = np.stack(np.unravel_index(np.arange(64), (4, 4, 4)), axis=1) - 4
    (tmp_path / "a.bt").write_bytes(_encode(keys, np.full(64, 1.5)))
    back, values, _ = decode_octomap(tmp_path / "a.bt")
    assert sorted(back.tolist()) == sorted(keys.tolist())
    assert (values > 0).all()


@pytest.mark.parametrize("keep", [0.3, 0.6, 0.95])
def test_a_truncated_file_is_a_format_error(tmp_path: Path, keep: float) -> None:
    rng = np.random.default_rng(0)
    keys = np.unique(rng.integers(-50, 50, (4000, 3)), axis=0).astype(np.int32)
    content = _encode(keys, rng.uniform(-2, 2, len(keys)).astype(np.float32))
    path = tmp_path / "cut"
    path.write_bytes(content[: int(len(content) * keep)])
    with pytest.raises(FormatError, match="truncated"):
        decode_octomap(path)


def test_a_header_without_a_tree_is_a_format_error(tmp_path: Path) -> None:
    (tmp_path / "a.bt").write_bytes(b"# Octomap OcTree binary file\n# cut\n")
    with pytest.raises(FormatError):
        decode_octomap(tmp_path / "a.bt")
