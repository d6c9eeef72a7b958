from __future__ import annotations

from pathlib import Path

import pytest

from recon.core.errors import SourceError
from recon.sources.image_names import find_images, pair_images


def touch(folder: Path, *names: str) -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")


def names(pairs: tuple[tuple[Path, Path], ...]) -> list[tuple[str, str]]:
    return [(left.name, right.name) for left, right in pairs]


def test_names_that_differ_in_side_are_paired_by_their_numbers(tmp_path: Path) -> None:
    touch(tmp_path, "left1.png", "left02.png", "left10.png")
    touch(tmp_path, "right10.png", "right01.png", "right2.png", "notes.txt")
    found = pair_images(str(tmp_path / "left*"), str(tmp_path / "right*.png"))
    assert not found.by_order
    assert names(found.pairs) == [
        ("left1.png", "right01.png"),
        ("left02.png", "right2.png"),
        ("left10.png", "right10.png"),
    ]


def test_a_number_of_the_camera_does_not_count(tmp_path: Path) -> None:
    touch(tmp_path, "cam0_7.png", "cam0_8.png", "cam1_8.png", "cam1_7.png")
    found = pair_images(str(tmp_path / "cam0*"), str(tmp_path / "cam1*"))
    assert names(found.pairs) == [("cam0_7.png", "cam1_7.png"), ("cam0_8.png", "cam1_8.png")]


def test_folders_are_paired_by_name_whatever_the_suffix(tmp_path: Path) -> None:
    touch(tmp_path, "L/a.png", "L/b.png", "R/b.jpg", "R/a.jpg")
    found = pair_images(tmp_path / "L", tmp_path / "R")
    assert names(found.pairs) == [("a.png", "a.jpg"), ("b.png", "b.jpg")]


def test_names_that_have_nothing_in_common_are_paired_by_order_and_that_is_reported(
    tmp_path: Path,
) -> None:
    touch(tmp_path, "L/100.png", "L/200.png", "R/101.png", "R/202.png")
    found = pair_images(tmp_path / "L", tmp_path / "R")
    assert found.by_order
    assert names(found.pairs) == [("100.png", "101.png"), ("200.png", "202.png")]


def test_a_single_pair_needs_no_names_in_common(tmp_path: Path) -> None:
    touch(tmp_path, "a.png", "b.png")
    found = pair_images(tmp_path / "a.png", str(tmp_path / "b.png"))
    assert names(found.pairs) == [("a.png", "b.png")]
    assert not found.by_order


@pytest.mark.parametrize(
    ("left", "right", "message"),
    [
        (
            ["l1.png", "l2.png", "l3.png"],
            ["r3.png", "r4.png", "r5.png"],
            r"most have no partner \(got 1 pair of 3 left, 3 right; l1\.png, l2\.png, r4\.png …",
        ),
        (["lx.png", "ly.png"], ["r.png"], r"do not pair up \(got 2 left, 1 right"),
    ],
)
def test_images_of_which_most_have_no_partner_are_refused(
    tmp_path: Path, left: list[str], right: list[str], message: str
) -> None:
    touch(tmp_path, *left, *right)
    with pytest.raises(SourceError, match=message):
        pair_images(str(tmp_path / "l*"), str(tmp_path / "r*"))


def test_images_without_a_partner_are_left_out_and_named(tmp_path: Path) -> None:
    touch(tmp_path, *(f"left{n}.png" for n in (1, 2, 3, 5)), "left_notes.png")
    touch(tmp_path, *(f"right{n}.png" for n in (1, 2, 3, 4)), "right_7_again.png")
    found = pair_images(str(tmp_path / "left*"), str(tmp_path / "right*"))
    assert [left.name for left, _ in found.pairs] == ["left1.png", "left2.png", "left3.png"]
    names = {path.name for path in found.lonely}
    assert names == {"left5.png", "left_notes.png", "right4.png", "right_7_again.png"}


def test_a_pattern_that_takes_both_sides_is_refused(tmp_path: Path) -> None:
    touch(tmp_path, "left1.png", "right1.png")
    with pytest.raises(SourceError, match=r"left1\.png: left and right are the same images"):
        pair_images(str(tmp_path / "*"), str(tmp_path / "*"))


def test_a_pattern_without_images_is_reported_and_to_be_quoted(tmp_path: Path) -> None:
    touch(tmp_path, "left1.txt")
    with pytest.raises(SourceError, match=r"no images found.*in quotes"):
        find_images(str(tmp_path / "left*"))
