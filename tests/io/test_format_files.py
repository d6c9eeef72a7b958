from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import FormatError
from recon.io.fields import read_yaml, write_yaml
from recon.io.files import read_bytes, read_table, read_text


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "file does not exist"),
        (b"", "file is empty"),
        (b"\xff\xfe\x00", r"not a text file \(got byte 0 is not UTF-8\)"),
    ],
)
def test_unreadable_text_is_one_clear_line_with_the_file(
    tmp_path: Path, content: bytes | None, message: str
) -> None:
    path = tmp_path / "times.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FormatError, match=rf"times\.txt: {message}"):
        read_text(path)


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"cannot read the file \(got Is a directory\)"):
        read_bytes(tmp_path)


def test_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbf1.5\n")
    assert read_text(tmp_path / "a.txt") == "1.5\n"


def test_table_skips_comments_and_empty_lines_and_remembers_line_numbers(tmp_path: Path) -> None:
    path = tmp_path / "t.txt"
    path.write_text("# t x\n1 2\n\n3, 4  # late\n")
    table, lines = read_table(path, (2,))
    np.testing.assert_array_equal(table, [[1, 2], [3, 4]])
    assert lines == [2, 4]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2\n1 2 3\n", r":2: wrong number of columns \(got 3, expected 2\)"),
        ("1 2\n1 nan\n", r":2: number is not finite \(got 1 nan\)"),
        ("1 x\n", r":1: not a number \(got 1 x\)"),
        ("# nothing\n", ": file contains no numbers"),
    ],
)
def test_a_bad_row_is_named_by_file_and_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "t.txt"
    path.write_text(text)
    with pytest.raises(FormatError, match=rf"t\.txt{message}"):
        read_table(path, (2,))


def test_all_rows_have_as_many_columns_as_the_first(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("1 2 3\n1 2\n")
    with pytest.raises(FormatError, match=r"t\.txt:2: wrong number of columns \(got 2, expected 3"):
        read_table(tmp_path / "t.txt", (2, 3))


def test_yaml_comes_back_as_it_was_written_and_in_order(tmp_path: Path) -> None:
    values = {"b": {"window_px": 9, "alpha": None}, "a": [1, 2.5, "größe"]}
    write_yaml(tmp_path / "c.yaml", values)
    assert read_yaml(tmp_path / "c.yaml") == values
    assert list(read_yaml(tmp_path / "c.yaml")) == ["b", "a"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1\nb: 2\n", r"c\.yaml:2: not a YAML file"),
        ("- 1\n", r"c\.yaml: YAML file is not a mapping \(got list\)"),
    ],
)
def test_bad_yaml_is_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(FormatError, match=message):
        read_yaml(tmp_path / "c.yaml")
