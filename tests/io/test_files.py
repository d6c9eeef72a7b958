from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.io.fields import read_yaml, write_yaml
from recon.io.files import read_table, read_text


def test_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbf1.5\n")
    assert read_text(tmp_path / "a.txt") == "1.5\n"


def test_table_skips_comments_and_empty_lines_and_remembers_line_numbers(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("# t x\n1 2\n\n3, 4  # late\n")
    table, lines = read_table(path, (2,))
    np.testing.assert_array_equal(table, [[1, 2], [3, 4]])
    assert lines == [2, 4]


def test_yaml_comes_back_as_it_was_written_and_in_order(tmp_path: Path) -> None:
    values = {"b": {"window_px": 9, "alpha": None}, "a": [1, 2.5, "größe"]}
    write_yaml(tmp_path / "c.yaml", values)
    assert read_yaml(tmp_path / "c.yaml") == values
    assert list(read_yaml(tmp_path / "c.yaml")) == ["b", "a"]
