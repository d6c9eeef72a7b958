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


@pytest.mark.parametrize(
    ("left", "right", "expected", "by_order"),
    [
        # By their numbers, where names differ in the side.
        (["left1.png", "left02.png", "left10.png"],
         ["right10.png", "right01.png", "right2.png", "right.txt"],
         ["left1.png right01.png", "left02.png right2.png", "left10.png right10.png"], False),
        # A number of the camera does not count.
        (["left0_7.png", "left0_8.png"], ["right1_8.png", "right1_7.png"],
         ["left0_7.png right1_7.png", "left0_8.png right1_8.png"], False),
        # By name, whatever the suffix.
        (["left/a.png", "left/b.png"], ["right/b.jpg", "right/a.jpg"],
         ["a.png a.jpg", "b.png b.jpg"], False),
        # By order, where names have nothing in common.
        (["left/100.png", "left/200.png"], ["right/101.png", "right/202.png"],
         ["100.png 101.png", "200.png 202.png"], True),
        (["left_a.png"], ["right_b.png"], ["left_a.png right_b.png"], False),
    ],
)  # fmt: skip
def test_images_are_paired_by_name_by_number_or_in_order(
    tmp_path: Path, left: list[str], right: list[str], expected: list[str], by_order: bool
) -> None:
    touch(tmp_path, *left, *right)
    sides = ("left", "right") if "/" in left[0] else ("left*", "right*")
    found = pair_images(*(str(tmp_path / side) for side in sides))
    assert [f"{one.name} {other.name}" for one, other in found.pairs] == expected
    assert found.by_order == by_order


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
