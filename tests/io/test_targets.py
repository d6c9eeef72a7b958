"""Boards are read from the files of kalibr and basalt."""

import pytest

from recon.core.errors import FormatError, SettingsError
from recon.io.cameras.targets import read_board

APRIL = (
    "target_type: 'aprilgrid' #gridtype\ntagCols: 6\ntagRows: 5\ntagSize: 0.088 #m\n"
    "tagSpacing: 0.3\n"
)
CHECKER = (
    "target_type: 'checkerboard'\ntargetCols: 7\ntargetRows: 6\nrowSpacingMeters: 0.06\n"
    "colSpacingMeters: 0.06\n"
)
CIRCLES = "target_type: circlegrid\ntargetCols: 4\ntargetRows: 11\nspacingMeters: 0.02\n"


@pytest.mark.parametrize(
    ("name", "content", "board"),
    [
        ("a.yaml", APRIL, "aprilgrid:6x5:88mm:0.3"),
        ("a.json", '{"tagCols": 6, "tagRows": 6, "tagSize": 0.088, "tagSpacing": 0.3}',
         "aprilgrid:6x6:88mm:0.3"),
        ("a.yml", CHECKER, "chess:7x6:60mm"),
        ("a.yaml", f"{CIRCLES}asymmetricGrid: False\n", "circles:4x11:20mm:8mm"),
        ("a.yaml", f"{CIRCLES}asymmetricGrid: True\n", "acircles:4x11:20mm:8mm"),
    ],
)  # fmt: skip
def test_a_target_is_read(tmp_path, name, content, board):
    (tmp_path / name).write_text(content)
    assert str(read_board(str(tmp_path / name))) == board


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (APRIL.replace("aprilgrid", "assembly"), "unknown target_type.*assembly.*aprilgrid"),
        (APRIL.replace("tagCols: 6", "tagCols: 6.5"), "tagCols.*positive integer"),
        (APRIL.replace("tagSize: 0.088", "tagSize: .nan"), "tagSize.*finite"),
        (APRIL.replace("tagSize: 0.088", "tagSize: 0"), "implausible"),
        (APRIL.replace("tagSpacing: 0.3", "tagSpacing: -1"), "cannot read this board"),
        (CHECKER.replace("row", "column"), "has no 'rowSpacingMeters'"),
        (CHECKER.replace("rowSpacingMeters: 0.06", "rowSpacingMeters: 0.05"), "not square"),
        ("- 1\n", "not a mapping"),
    ],
)
def test_what_is_no_target_is_refused(tmp_path, content, message):
    (tmp_path / "a.yaml").write_text(content)
    with pytest.raises((FormatError, SettingsError), match=message):
        read_board(str(tmp_path / "a.yaml"))


def test_a_text_is_no_file_and_a_file_that_is_not_there_is_said():
    assert str(read_board("chess:9x6:25mm")) == "chess:9x6:25mm"
    with pytest.raises(FormatError, match="does not exist"):
        read_board("nowhere.yaml")
